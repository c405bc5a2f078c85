"""The bar says what it should on a terminal and nothing anywhere else."""

import io

from rich.console import Console

from thorndike.training.progress import Progress, describe


def terminal(width=140):
    return Console(file=io.StringIO(), force_terminal=True, width=width, color_system=None)


def test_a_terminal_sees_steps_speed_and_the_return_with_its_interval():
    console = terminal()
    with Progress(100_000, console=console) as progress:
        progress.update(51_200, 212.43, (180.1, 240.9), 320_000)
    assert "51.2k/100k steps · 320k/s · return 212.4 [180.1, 240.9]" in console.file.getvalue()
    assert "left" in console.file.getvalue()


def test_the_words_fit_into_80_columns():
    console = terminal(width=80)
    with Progress(1_000_000, console=console) as progress:
        progress.update(512_000, -1234.5, (-1301.2, -1180.9), 1_320_000)
    assert "512k/1M steps · 1.32M/s · return -1234 [-1301, -1181]" in console.file.getvalue()
    assert "…" not in console.file.getvalue()


def test_a_resumed_run_starts_where_it_stopped():
    console = terminal()
    Progress(100, console=console, done_steps=40).close()
    assert "40/100 steps · compiling" in console.file.getvalue()


def test_nothing_is_written_when_output_is_no_terminal():
    console = Console(file=io.StringIO(), force_terminal=False)
    with Progress(10, console=console) as progress:
        progress.update(10, 1.0, None, 5.0)
    assert console.file.getvalue() == ""


def test_nothing_is_written_when_it_is_switched_off():
    console = terminal()
    with Progress(10, enabled=False, console=console) as progress:
        progress.update(10)
    assert console.file.getvalue() == ""


def test_closing_twice_and_updating_afterwards_is_harmless():
    console = terminal()
    progress = Progress(10, console=console)
    progress.close()
    written = console.file.getvalue()
    progress.close()
    progress.update(5)
    assert console.file.getvalue() == written


def test_unknown_figures_are_left_out():
    assert describe(2_000_000, 500, None, None, None) == "500/2M steps"
    assert describe(10, 5, 1.0, None, None) == "5/10 steps · return 1"
