"""A worker process as its parent sees it: started, told, heard and, in the end, always gone."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence

from thorndike.environments.host.faults import Fault, gone
from thorndike.environments.host.worker import CLOSE, COMMAND, DONE, LONGEST_ANSWER

_PROGRAM = "import sys, json; sys.path[:] = json.loads(sys.argv[1]); from thorndike.environments.host.worker import main; main()"
_MOMENT = 0.005
_DYING = 1.0
"""Seconds in which a process that closed its connection, or was killed, is gone."""


class WorkerProcess:
    """One process of a pool, in a process group of its own: Ctrl-C is the parent's affair, and what it starts ends with it."""

    def __init__(self, row: int, count: int, block: int, constructor: bytes) -> None:
        self.row = row
        # Whole messages: none is ever half there, whenever the worker dies.
        self.connection, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        parent_end, alive = os.pipe()
        # Nothing is ever written to it: its closing, by this process's death at the latest, kills the worker.
        self._alive = os.fdopen(alive, "wb", buffering=0)
        stdin = os.memfd_create("thorndike-constructor", os.MFD_CLOEXEC)
        try:
            os.write(stdin, constructor)
            os.lseek(stdin, 0, os.SEEK_SET)
            files = (theirs.fileno(), block, parent_end)
            words = [sys.executable, "-c", _PROGRAM, json.dumps(sys.path), *(str(number) for number in (*files, row, count))]
            # What an environment prints goes to stderr: stdout is for answers.
            self._process = subprocess.Popen(words, pass_fds=files, stdin=stdin, stdout=sys.__stderr__, process_group=0)
        finally:
            theirs.close()
            os.close(parent_end)
            os.close(stdin)

    def tell(self, command: bytes, seed: int = 0) -> None:
        """Send one command. A dead worker is found out by who listens to it."""
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.connection.send(COMMAND.pack(command, seed))

    def hear(self) -> None:
        """Take its answer, which is there. Raises Fault for anything but DONE."""
        try:
            answer = self.connection.recv(LONGEST_ANSWER)
        except ConnectionResetError:
            answer = b""
        if answer == DONE:
            return
        if not answer:
            raise self.end_fault()
        told = json.loads(answer)
        fault = Fault(told["what"], told["mend"], self.row)
        if told["traceback"]:
            fault.add_note(told["traceback"])
        raise fault

    def is_alive(self) -> bool:
        """Whether it still runs. It is not reaped, so that its process group keeps its number until ``kill``."""
        return self._status() is None

    def end_fault(self) -> Fault:
        """How a worker that closed its connection ended."""
        deadline = time.monotonic() + _DYING
        while (status := self._status()) is None and time.monotonic() < deadline:
            time.sleep(_MOMENT)
        if status is None:
            return Fault("closed its connection", "do not close files it has not opened", self.row)
        return gone(status, self.row)

    def kill(self) -> None:
        """End it and whatever it started, and close all that is held of it."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self.connection.close()
        self._alive.close()
        # A process that waits for a broken disk dies when the disk answers, and no sooner.
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_DYING)

    def _status(self) -> int | None:
        """Its exit status, minus a signal's number, or None while it runs."""
        if self._process.returncode is not None:
            return self._process.returncode
        try:
            ended = os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)
        except ChildProcessError:
            # Somebody else's wait took it.
            return 0
        if ended is None:
            return None
        return ended.si_status if ended.si_code == os.CLD_EXITED else -ended.si_status


def end_all(workers: Sequence[WorkerProcess], grace: float) -> None:
    """Ask all to close their environments, and after `grace` seconds kill those that have not. Then none is left."""
    for worker in workers:
        worker.tell(CLOSE)
    deadline = time.monotonic() + grace
    while any(worker.is_alive() for worker in workers) and time.monotonic() < deadline:
        time.sleep(_MOMENT)
    for worker in workers:
        worker.kill()
