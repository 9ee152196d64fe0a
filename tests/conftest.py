"""For every test."""

from __future__ import annotations

import signal

from hypothesis import settings

# A shell that runs the tests in the background has them ignore Ctrl-C, and the processes that tests start would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# How long an example takes says more about who else uses the machine than about the code.
settings.register_profile("vilp", deadline=None)
settings.load_profile("vilp")
