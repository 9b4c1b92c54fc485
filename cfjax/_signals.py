"""Ctrl-C and SIGTERM end the command at once, with one line and without partial files.

A separate thread waits for them. Python's handlers run in the main thread, which is busy as long as
a program compiles; and their exceptions may come out of JAX as another error, or crash the
interpreter while it ends.
"""

import os
import signal
import socket
import sys
import threading
from pathlib import Path

_WORDS: dict[int, str] = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}

# Held while files are half written: the end waits for it.
busy = threading.Lock()


def is_command() -> bool:
    """Whether this process is `python -m cfjax` or `cfjax`, both of which import the package."""
    name = sys.argv[0] if sys.argv else ""
    # Python imports the package of `-m` before it knows the file to run.
    return (sys.orig_argv[-len(sys.argv)] if name == "-m" else Path(name).stem) == "cfjax"


def end_the_command() -> None:
    """From now on SIGINT and SIGTERM end the process, with status 130 and 143."""
    inbox, outbox = socket.socketpair()
    outbox.setblocking(False)
    for number in _WORDS:
        # As left by `nohup` and the like.
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, lambda *_: None)
    signal.set_wakeup_fd(outbox.detach())
    threading.Thread(target=_wait, args=(inbox,), daemon=True).start()


def _wait(inbox: socket.socket) -> None:
    while (number := inbox.recv(1)[0]) not in _WORDS:
        pass  # Others may be handled elsewhere.
    with busy:
        try:
            # A progress bar hides the cursor.
            clean = "\r\x1b[2K\x1b[?25h" if os.isatty(2) else ""
            os.write(2, f"{clean}cfjax: {_WORDS[number]}\n".encode())
        finally:
            os._exit(128 + number)
