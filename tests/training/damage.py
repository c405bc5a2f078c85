"""What damage can look like. Each function takes a sealed folder and a source of chance, and changes something in it."""

import random
import shutil
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file, save

from thorndike.training.sealed_folders import NewFolder


def flip_a_bit(folder: Path, chance: random.Random) -> None:
    path = chance.choice(sorted(path for path in folder.iterdir() if path.stat().st_size))
    content = bytearray(path.read_bytes())
    content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    path.write_bytes(content)


def truncate(folder: Path, chance: random.Random) -> None:
    path = chance.choice(sorted(path for path in folder.iterdir() if path.stat().st_size))
    path.write_bytes(path.read_bytes()[: chance.randrange(path.stat().st_size)])


def remove_a_file(folder: Path, chance: random.Random) -> None:
    chance.choice(sorted(folder.iterdir())).unlink()


def add_a_file(folder: Path, chance: random.Random) -> None:
    (folder / chance.choice(["extra.json", "evil.py", "00.block", ".hidden"])).write_bytes(b"\0" * chance.randrange(20))


def replace_by_a_link(folder: Path, chance: random.Random) -> None:
    path = chance.choice(sorted(folder.iterdir()))
    path.unlink()
    path.symlink_to("/dev/zero")


def replace_by_a_folder(folder: Path, chance: random.Random) -> None:
    path = chance.choice(sorted(folder.iterdir()))
    path.unlink()
    path.mkdir()


HOSTILE = [
    b"",
    b"null",
    b"[]",
    b"{",
    b'{"format": NaN}',
    b'{"a": ' * 100_000,
    b"[" * 100_000,
    b'{"format": 2, "files": {"../run.json": 1}}',
    b'{"format": 2, "files": []}',
    b'{"format": 2}',
    b'{"format": 3, "files": {}}',
    b'{"format": "2", "files": {}}',
    b'{"sha256": 5}',
    b'{"sha256": {"state.safetensors": null}}',
    b'{"sha256": {}}',
    b"1" * 10_000,
    b'"\\ud800"',
    b"\xff\xfe",
    b'{"iteration": 1e999}',
    b'{"iteration": "1", "wall_s": 0, "cpu_s": 0}',
    b'{"iteration": -1, "wall_s": 0, "cpu_s": 0}',
    b'{"iteration": true, "wall_s": 0, "cpu_s": 0}',
    b'{"iteration": 2, "wall_s": NaN, "cpu_s": 0}',
    b'{"iteration": 2, "wall_s": 0, "cpu_s": 0, "request": [1]}',
    b'{"iteration": 2}',
    b'{"0/ring": 1}',
    b'{"0/ring": {"dtype": "object", "shape": [1], "blocks": []}}',
    b'{"0/ring": {"dtype": "float32", "shape": [-1], "blocks": []}}',
    b'{"0/ring": {"dtype": "float32", "shape": [99999999999999], "blocks": []}}',
    b'{"0/ring": {"dtype": "float32", "shape": [0], "blocks": []}}',
    b'{"0/ring": {"dtype": "float32", "shape": ["5000"], "blocks": [null]}}',
    b'{"1/extra": {"dtype": "float32", "shape": [0], "blocks": []}}',
]


def write_hostile_json(folder: Path, chance: random.Random) -> None:
    chance.choice(sorted(folder.glob("*.json"))).write_bytes(chance.choice(HOSTILE))


def seal_again(folder: Path) -> None:
    """A manifest that fits what is there now, as somebody who means harm would write it."""
    files = {path.name: path.read_bytes() for path in folder.iterdir() if path.name != "manifest.json"}
    shutil.rmtree(folder)
    new = NewFolder(folder)
    for name, content in files.items():
        new.write(name, content)
    new.publish(folder.with_name("sealed"))
    folder.with_name("sealed").rename(folder)


def seal_hostile_json(folder: Path, chance: random.Random) -> None:
    path = chance.choice(sorted(path for path in folder.glob("*.json") if path.name != "manifest.json"))
    path.write_bytes(chance.choice(HOSTILE))
    seal_again(folder)


def seal_other_arrays(folder: Path, chance: random.Random) -> None:
    """Another shape, another dtype, one array too few or too many, or no safetensors file at all."""
    (path,) = folder.glob("*.safetensors")
    arrays = {name: array.copy() for name, array in load_file(path).items()}
    name = chance.choice(sorted(arrays))
    changes = {
        "shape": lambda: arrays.update({name: np.zeros((*arrays[name].shape, 2), arrays[name].dtype)}),
        "dtype": lambda: arrays.update({name: arrays[name].astype(np.float64)}),
        "missing": lambda: arrays.pop(name),
        "extra": lambda: arrays.update({name + "/more": np.zeros(2)}),
    }
    kind = chance.choice([*changes, "header", "nothing"])
    if kind in changes:
        changes[kind]()
        path.write_bytes(save(arrays))
    elif kind == "header":
        path.write_bytes((2**63 - 1).to_bytes(8, "little") + b"{" * 100)
    else:
        path.write_bytes(bytes(chance.randrange(256) for _ in range(chance.randrange(200))))
    seal_again(folder)


DAMAGES = [
    flip_a_bit,
    flip_a_bit,
    truncate,
    remove_a_file,
    add_a_file,
    replace_by_a_link,
    replace_by_a_folder,
    write_hostile_json,
    seal_hostile_json,
    seal_other_arrays,
]
