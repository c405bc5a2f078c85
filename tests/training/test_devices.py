"""Seeds over several devices: shares of the same size, and the same bits whatever the number."""

import hashlib
import subprocess
import sys
from pathlib import Path

import pytest

from thorndike import startup
from thorndike.errors import UserError
from thorndike.startup import device_count, without_device_count
from thorndike.training.devices import devices_for

TRAIN_TWICE = """
import sys
from thorndike import startup
startup.count_cores_as_devices(2)
import thorndike as td
settings = {"n_steps": 8, "batch_size": 16, "n_epochs": 1, "net_arch": (8,)}
for devices in (1, 2):
    td.train("ppo", "CartPole-v1", steps=64, seeds=4, num_envs=2, settings=settings, preset="none", devices=devices,
             output=sys.argv[1], name=f"on{devices}")
"""


@pytest.mark.parametrize(("seeds", "at_most", "expected"), [(1, 8, 1), (8, 2, 2), (8, 3, 2), (9, 4, 3), (7, 4, 1), (4, 16, 4)])
def test_every_device_gets_the_same_number_of_seeds(seeds, at_most, expected):
    assert devices_for(seeds, at_most) == expected


def test_a_seed_has_the_same_bits_on_one_device_and_on_two(tmp_path):
    subprocess.run([sys.executable, "-c", TRAIN_TWICE, str(tmp_path)], check=True, capture_output=True)
    one, two = (sorted(tmp_path.glob(f"*/*/*on{devices}/checkpoints/*/state.safetensors")) for devices in (1, 2))
    assert [path.parent.name for path in one] == [path.parent.name for path in two] != []
    assert [digest(path) for path in one] == [digest(path) for path in two]


def test_as_many_devices_are_used_as_there_are_and_were_asked_for():
    assert device_count(100) == device_count(None) >= device_count(1) == 1
    with pytest.raises(UserError, match="devices=0: training needs one at least"):
        device_count(0)


def test_the_number_of_devices_is_no_difference_between_machines():
    assert without_device_count("--a=1 --xla_force_host_platform_device_count=2 --b=2") == "--a=1 --b=2"


@pytest.mark.parametrize(("jaxlib", "known"), [("0.10.2", True), ("0.99.0", False)])
def test_xla_is_given_an_option_once_and_only_where_it_knows_it(jaxlib, known, monkeypatch):
    monkeypatch.setattr(startup, "version", lambda package: jaxlib)
    # Memory of this process stays as it is.
    monkeypatch.setattr(startup.sys, "platform", "elsewhere")
    monkeypatch.setenv("XLA_FLAGS", "--mine=1")
    for _ in range(2):
        startup.prepare_large_steps()
    option = "--xla_cpu_enable_concurrency_optimized_scheduler=false"
    assert startup.os.environ["XLA_FLAGS"] == (f"--mine=1 {option}" if known else "--mine=1")


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
