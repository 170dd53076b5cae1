"""Hear Ctrl-C again: the last module that the fork server of ``process_pool`` imports, which starts deaf."""

import signal

# Its children inherit the mask. What was pressed during the imports is dropped.
signal.signal(signal.SIGINT, signal.SIG_IGN)
signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
signal.signal(signal.SIGINT, signal.default_int_handler)
