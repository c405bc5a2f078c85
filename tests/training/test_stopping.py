"""The first signal asks, the second acts, and nothing takes longer than it may."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from thorndike.training.stopping import prompt_exit, stop_requests

WORK = """
import hashlib, sys, time
from thorndike.training import stopping
stopping.GRACE_S = 1.0
with stopping.prompt_exit():
    with stopping.stop_requests() as stopped:
        print("ready", flush=True)
        if sys.argv[1] == "orderly":
            while stopped() is None:
                time.sleep(0.01)
            print("saved", flush=True)
            stopping.leave(128 + stopped())
        if sys.argv[1] == "saving":
            with stopping.saving():
                time.sleep(1.5)
            print("saved", flush=True)
        # One call of C: Python's own handlers must wait for its end.
        hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)
"""


def stopped(how: str, number: int, again: float | None = None) -> tuple[int, float, str, str]:
    """Exit status, seconds from the signal to the end, what was printed."""
    process = subprocess.Popen([sys.executable, "-c", WORK, how], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.readline()
    began = time.monotonic()
    process.send_signal(number)
    if again is not None:
        time.sleep(again)
        process.send_signal(number)
    out, err = process.communicate(timeout=30)
    return process.returncode, time.monotonic() - began, out, err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_orderly_stop_is_let_happen(number):
    status, _, out, err = stopped("orderly", number)
    assert (status, out, err) == (128 + number, "saved\n", "")


def test_what_does_not_end_is_cut_short():
    status, seconds, _, err = stopped("hangs", signal.SIGTERM)
    assert status == 143
    assert 0.9 < seconds < 3
    assert err == "thorndike: it took too long to end in order and was cut short; a run goes on from its last checkpoint\n"


def test_a_second_signal_acts_at_once():
    status, seconds, _, _ = stopped("hangs", signal.SIGINT, again=0.1)
    assert status == 130
    assert seconds < 0.95, "half a second to unwind, in place of the whole grace"


def test_a_checkpoint_being_written_is_waited_for():
    status, seconds, out, _ = stopped("saving", signal.SIGTERM)
    assert (status, out) == (143, "saved\n")
    assert seconds > 1.3


IMPORTS = """
import sys
from thorndike.training.stopping import prompt_exit
sys.path.insert(0, sys.argv[1])
with prompt_exit():
    try:
        import slow_to_import
    except BaseException as error:
        print("unwound through the module", type(error), flush=True)
        raise
"""


@pytest.mark.parametrize(("number", "word"), [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "terminated")])
def test_an_import_is_left_at_once_and_never_unwound(number, word, tmp_path):
    """Compiled modules end by signal 6 or 11 where an exception comes in the middle of their import."""
    (tmp_path / "slow_to_import.py").write_text("import time\nprint('ready', flush=True)\nfor _ in range(600): time.sleep(0.05)\n")
    process = subprocess.Popen([sys.executable, "-c", IMPORTS, str(tmp_path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.readline()
    process.send_signal(number)
    out, err = process.communicate(timeout=30)
    assert (process.returncode, out, err) == (128 + number, "", f"thorndike: {word}\n")


def test_requests_are_noted_and_the_handlers_put_back():
    noted = []
    before = signal.signal(signal.SIGINT, lambda *arguments: noted.append("second"))
    try:
        with stop_requests() as asked:
            assert asked() is None
            os.kill(os.getpid(), signal.SIGINT)
            assert asked() == signal.SIGINT
            os.kill(os.getpid(), signal.SIGINT)
            assert noted == ["second"]
        os.kill(os.getpid(), signal.SIGINT)
        assert noted == ["second", "second"]
    finally:
        signal.signal(signal.SIGINT, before)


def test_outside_the_main_thread_nothing_is_touched():
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    found = []

    def work():
        with prompt_exit(), stop_requests() as asked:
            found.append((asked(), [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [(None, before)]


def test_a_command_that_ends_leaves_everything_as_it_was():
    before, threads = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)], threading.active_count()
    with prompt_exit():
        assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] != before
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before
    assert threading.active_count() == threads
    assert signal.set_wakeup_fd(-1) == -1
