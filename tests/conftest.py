"""Settings of all tests."""

from hypothesis import settings

# Times of single examples vary with the machine's load: they say nothing.
settings.register_profile("optshape", deadline=None)
settings.load_profile("optshape")
