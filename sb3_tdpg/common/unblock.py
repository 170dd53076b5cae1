"""Unblock Ctrl-C in the fork server of ``process_pool``: it starts with Ctrl-C blocked and imports this file last."""

import signal

# The server's children inherit the signal mask. A Ctrl-C that was pressed during the imports is dropped.
signal.signal(signal.SIGINT, signal.SIG_IGN)
signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
signal.signal(signal.SIGINT, signal.default_int_handler)
