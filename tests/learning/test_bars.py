"""The learning bars, from the presets: hours of CPU, run by `make test-slow`. Their results are kept in benchmarks/results/learning."""

import importlib.util
from pathlib import Path

import pytest

_PATH = Path(__file__).parents[2] / "benchmarks" / "learning.py"
_SPEC = importlib.util.spec_from_file_location("learning", _PATH)
assert _SPEC is not None and _SPEC.loader is not None
learning = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(learning)


@pytest.mark.slow
@pytest.mark.parametrize("bar", learning.BARS, ids=lambda bar: f"{bar.algorithm}-{bar.environment}")
def test_ten_seeds_of_the_preset_reach_the_published_result(bar: object, tmp_path: Path) -> None:
    content = learning.measure(bar, tmp_path)
    assert content["met"], (content["mean"], content["iqm"], content["per_seed"])
