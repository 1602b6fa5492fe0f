"""Settings of all tests."""

import signal

from hypothesis import settings

# Times of single examples vary with the machine's load: they say nothing.
settings.register_profile("optshape", deadline=None)
settings.load_profile("optshape")

# A shell's background jobs ignore SIGINT, and so would every process that is started here and then interrupted.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
