"""Settings of all tests."""

import os
import signal

from hypothesis import settings

# Times of single examples vary with the machine's load: they say nothing. `make test` tries the same examples whenever
# it runs, so that what fails was changed; `make faults` and HYPOTHESIS_PROFILE=random try new ones.
settings.register_profile("optshape", deadline=None, derandomize=True)
settings.register_profile("random", deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "random" if "FAULTS" in os.environ else "optshape"))

# A shell's background jobs ignore SIGINT, and so would every process that is started here and then interrupted.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
