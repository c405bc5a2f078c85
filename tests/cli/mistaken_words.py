"""Command lines and run directories with a mistake in them, drawn by chance: each is wrong in at least one way by construction."""

import json
import random
import string
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from thorndike.algorithms import ALGORITHMS
from thorndike.cli.main import VERBS
from thorndike.config_fields import read_config_fields


class Mistake(NamedTuple):
    """A command line."""

    kind: str
    words: list[str]


OF_RUNS = ("show", "eval", "watch", "resume", "reproduce", "plot", "compare", "record")
TRAINED = ("ppo", "a2c", "reinforce", "dqn", "q_learning")
FROM_DATA = ("bc", "cql", "iql", "td3_bc")
FLAGS = {
    "train": [
        "--steps",
        "--seeds",
        "--seed",
        "--num-envs",
        "--max-episode-steps",
        "--checkpoint-every",
        "--keep-checkpoints",
        "--n-envs",
        "--total-timesteps",
        "-n",
    ],
    "bench": ["--steps", "--seeds", "--seed", "--num-envs", "--repeat"],
    "eval": ["--episodes", "--seed", "--num-envs"],
    "record": ["--episodes", "--steps", "--seed"],
    "ope": ["--seed", "--fqe-steps"],
    "watch": ["--episodes", "--seed"],
    "resume": ["--steps", "-n"],
    "reproduce": ["--steps"],
    "compare": ["--episodes"],
    "check-env": ["--steps", "--seed", "--max-episode-steps"],
    "arena": ["--games", "--seed"],
    "play": ["--seed"],
}
"""Flags that take a whole number."""
OTHER_FLAGS = [
    "set",
    "env-set",
    "preset",
    "engine",
    "device",
    "output",
    "name",
    "algo",
    "env",
    "env-id",
    "json",
    "help",
    "version",
    "metric",
]
OTHER_FLAGS += ["games", "simulations", "opening-plies", "save", "second"]
OTHER_FLAGS += ["against", "failed-below", "plot", "file", "title", "video", "window", "stochastic", "eval-episodes", "n-timesteps"]
OTHER_FLAGS += [
    "total-steps",
    "start-from",
    "deterministic",
    "random-share",
    "to",
    "data",
    "methods",
    "gamma",
    "fqe-steps",
    "port",
    "open",
    "host",
]
NO_NUMBERS = [
    "",
    " ",
    "nan",
    "inf",
    "-inf",
    "1e999",
    "-1",
    "1.5",
    "0x10",
    "1e-3",
    "five",
    "1,000",
    "1e",
    "1 000",
    "--",
    "9" * 5000,
    "1e308g",
]
NO_NUMBERS += [
    "1e60",
    "-0.5",
    "None",
    "True",
    "½",
    "1__",
    "_1",
    ".",
    "e5",
    "k",
    "\N{RIGHT-TO-LEFT OVERRIDE}1",
    "1\n2x",
    "[1]",
    "5 kg",
    "+-1",
]
JUNK = [
    "",
    " ",
    "\t",
    "\n",
    "a\nb",
    "\r\n",
    "\x1b[31mred",
    "\x07",
    "\x7f",
    "\x85",
    "\u2028",
    "é",
    "ДДД",
    "強化学習",
    "🤖",
    "\u202etxt",
    "e\u0301" * 30,
]
JUNK += ["\udcff\udcfe", "%s%n%d", "{0}{name}", "[bold]x[/bold]", "'; true #", "$(true)", "../..", "/", ".", "~", "nul", "*", "?" * 300]
JUNK += ["x" * 5000, "ppo" * 30_000, "null", "NaN", "1e5", "=", "==", "a=b", ":", "::", "\\", '"', "#", "|", "@file", "C:\\x"]
WRONG_VALUES = {
    "int": ["x", "1.5", "nan", "inf", "1e999", "true", "[1]", "1,2", "9" * 400, "1e300", "-" * 20, "0x1"],
    "float": ["x", "nan", "inf", "-inf", "1e999", "[1]", "1,2", "linear", "1..2", "0.1.2", "3e", "linear(1)", "linear(nan, 0)"],
    "bool": ["x", "2", "maybe", "nan", "tru", "-1", "[]", "0.0"],
}
"""No setting of these types takes one of these texts (1e300 and 9999... are whole numbers that no program could use)."""
IDS = ["CartPole-v1", "FrozenLake-v1", "Pendulum-v1", "LunarLander-v3", "probe/Counting-v0", "Blackjack-v1", "HalfCheetah-v5"]
FILES = {
    "syntax.py": b"class Env(:\n",
    "raises.py": b"raise RuntimeError('two\\nlines')\n",
    "leaves.py": b"import sys; sys.exit(0)\n",
    "nothing.py": b"",
    "not_env.py": b"class Env:\n    pass\n",
    "cannot.py": b"class Env:\n    def __init__(self, **settings): raise OSError('no\\nsuch thing')\n",
    "number.py": b"Env = 5\n",
    "zeros.py": b"\0" * 10,
    "latin.py": b"x = '\xff'\n",
    "text.txt": b"Env\n",
}
"""Files of environments that are none."""
NO_OBJECTS = [
    b"",
    b"{",
    b"[]",
    b"null",
    b"5",
    b'"text"',
    b"\xff\xfe",
    b"[" * 50_000,
    b'{"a":' * 50_000,
    b"1" * 6000,
    b'{"a": 1}}',
    b"{'a': 1}",
    b"\0" * 9,
]
NO_OBJECTS += [
    b'{"a": tru}',
    b'{"a": 1,}',
    b'{"\\ud800',
    b"{" + b'"a": [' * 60 + b"]" * 60 + b"}",
    b"<html>",
]
FACTS: dict[str, object] = {
    "format": 1,
    "status": "interrupted",
    "algorithm": "ppo",
    "environment": "CartPole-v1",
    "env_kwargs": {},
    "max_episode_steps": None,
    "engine": "native",
    "config": {"total_steps": 1000},
    "wrappers": [],
    "preset": "none",
    "steps": 1000,
    "seeds": 2,
    "seed": 0,
    "num_envs": 4,
    "log_every": 10,
    "checkpoint_every": 100,
    "network": "default",
    "environment_object": False,
    "device": "cpu",
    "processors": "1",
}
"""A sound run.json."""
WRONG_FACTS = {
    "format": [0, 2, "1", None, 1e9, []],
    "algorithm": ["", "pppo", 5, None, [], {}, "\x1b[2Jppo", "planning", "p" * 5000, "os.system"],
    "environment": [5, None, [], "two\nlines", "x" * 5000, {}],
    "env_kwargs": [None, 5, [], "x"],
    "max_episode_steps": [0, -1, "5", 1.5, True, 10**30],
    "engine": [5, None, [], "two\nlines", {}],
    "config": [
        None,
        5,
        [],
        "x",
        {"gama": 1},
        {"gamma": "x"},
        {"gamma": 5},
        {"gamma": [[1]]},
        {"__class__": 1},
        {"n_steps": None},
        {"n_steps": 0},
    ],
    "wrappers": [None, 5, {}, ["x"], [5], [[]]],
    "preset": [5, None, [], "\0"],
    "steps": [0, -1, "5", 1e300, True, None, 10**30],
    "seeds": [0, -1, "x", 1.5, 10**12, None, True],
    "seed": [-1, 2**32, "x", None, 0.5],
    "num_envs": [0, -4, "x", 10**12, None],
    "log_every": [0, "x", None],
    "checkpoint_every": [0, -1, "x", None],
    "network": [5, None, []],
    "environment_object": [0, "x", None],
    "device": [5, None],
    "processors": [5, None],
}
"""Values that a field of run.json cannot have."""


def mistakes(chance: random.Random, place: Path) -> Iterator[Mistake]:
    """Command lines without an end; `place` is the folder they are to be run in, which `furnish` has filled."""
    while True:
        kind = chance.choice(list(KINDS))
        words = KINDS[kind](chance, place)
        if chance.random() < 0.2 and "--" not in words:
            words.insert(chance.randrange(len(words) + 1) if kind != "value missing" else 0, "--json")
        yield Mistake(kind, words)


def furnish(place: Path) -> None:
    """Fill a folder with files that are no environments, and folders that are no runs."""
    (place / "empty").mkdir(parents=True)
    (place / "folder.py").mkdir()
    for name, content in FILES.items():
        (place / name).write_bytes(content)
    for name, content in run_files().items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_bytes(content)


def run_files() -> dict[str, bytes]:
    """Runs of every wrong kind: ``broken-*`` hold no object at all, ``wrong-*`` one with a wrong value, ``twin-*`` share a name."""
    found = {f"broken/E/ppo/broken-{number}/run.json": content for number, content in enumerate(NO_OBJECTS)}
    for name, values in WRONG_FACTS.items():
        found |= {f"wrong/E/ppo/wrong-{name}-{i}/run.json": json.dumps(FACTS | {name: value}).encode() for i, value in enumerate(values)}
        missing = {key: value for key, value in FACTS.items() if key != name}
        found[f"wrong/E/ppo/wrong-{name}-missing/run.json"] = json.dumps(missing).encode()
    for number in (1, 2):
        found[f"twins/E/ppo/twin-{number}/run.json"] = json.dumps(FACTS).encode()
    for number, content in enumerate(NO_OBJECTS):
        found[f"policies/E/ppo/policy-{number}/run.json"] = json.dumps(FACTS).encode()
        found[f"policies/E/ppo/policy-{number}/policy/manifest.json"] = content
        found[f"lines/E/ppo/lines-{number}/run.json"] = json.dumps(FACTS).encode()
        found[f"lines/E/ppo/lines-{number}/metrics.jsonl"] = content + b"\n"
        found[f"evaluated/E/ppo/evaluated-{number}/run.json"] = json.dumps(FACTS).encode()
        found[f"evaluated/E/ppo/evaluated-{number}/evaluations.jsonl"] = content + b"\n"
    return found


def misspelt(chance: random.Random, word: str) -> str:
    """`word` with one to three letters changed, dropped, doubled or swapped."""
    letters = list(word)
    for _ in range(chance.randint(1, 3)):
        at = chance.randrange(len(letters)) if letters else 0
        change = chance.choice(["drop", "double", "other", "swap"])
        if change == "drop":
            letters[at : at + 1] = []
        elif change == "double":
            letters[at:at] = letters[at : at + 1]
        elif change == "other":
            letters[at : at + 1] = chance.choice(string.ascii_lowercase + "é_ 5")
        else:
            letters[at : at + 2] = reversed(letters[at : at + 2])
    return "".join(letters)


def unlike(chance: random.Random, known: Callable[[str], bool], words: list[str]) -> str:
    """Junk, or one of `words` misspelt: something that is not known."""
    while True:
        word = chance.choice(JUNK) if chance.random() < 0.5 else misspelt(chance, chance.choice(words))
        if not known(word) and not word.startswith("-"):
            return word


def sound(chance: random.Random, verb: str) -> list[str]:
    """A command line of a verb in which nothing is wrong but that its run does not exist."""
    if verb in ("train", "bench"):
        return [verb, chance.choice(["ppo", "a2c", "reinforce"]), chance.choice(IDS)]
    if verb in ("plot", "compare"):
        return [verb, "no-run", "no-other-run"]
    if verb in OF_RUNS:
        return [verb, "no-run"]
    if verb == "ope":
        return [verb, "no-run", "--data", "empty"]
    if verb in ("arena", "play"):
        return [verb, "connect_four", *(["random", "random"] if verb == "arena" else [])]
    return {"check-env": [verb, chance.choice(IDS)], "list": [verb, "algorithms"], "info": [verb]}.get(verb, [verb])


def no_verb(chance: random.Random, place: Path) -> list[str]:
    word = unlike(chance, lambda word: word in VERBS, list(VERBS))
    return [word, *chance.sample(["ppo", "CartPole-v1", "--steps", "5"], chance.randrange(4))]


def flag_before_verb(chance: random.Random, place: Path) -> list[str]:
    return [chance.choice(["--steps", "-x", "--verbose", "-", "--jsn", "---", "--=", "-5", "--steps=5"])]


def unknown_flag(chance: random.Random, place: Path) -> list[str]:
    words = sound(chance, chance.choice(list(VERBS)))
    known = {name.replace("-", "") for flags in [*FLAGS.values(), OTHER_FLAGS] for name in flags}
    known |= {name.replace("_", "") for algorithm in ALGORITHMS for name in read_config_fields(algorithm)}
    spelled = sorted({flag.strip("-") for flags in FLAGS.values() for flag in flags} | set(OTHER_FLAGS))
    while True:
        flag = misspelt(chance, chance.choice(spelled)) if chance.random() < 0.7 else chance.choice(JUNK)
        plain = flag.partition("=")[0].replace("-", "").replace("_", "")
        if plain and plain not in known and " " not in flag:
            break
    words.insert(chance.randrange(1, len(words) + 1), "--" + flag + chance.choice(["", "=5", "=", "=x=y"]))
    return words


def value_missing(chance: random.Random, place: Path) -> list[str]:
    verb = chance.choice(list(FLAGS))
    return [*sound(chance, verb), chance.choice(FLAGS[verb])]


def no_number(chance: random.Random, place: Path) -> list[str]:
    verb = chance.choice(list(FLAGS))
    flag, value = chance.choice(FLAGS[verb]), chance.choice([*NO_NUMBERS, *(junk for junk in JUNK if junk != "1e5")])
    if chance.random() < 0.1 and flag != "--seed":
        value = chance.choice(["0", "-5", "0.0", "0e5"])
    if chance.random() < 0.1 and flag == "--seed":
        value = chance.choice(["4294967296", "1e10", "5G", "99999999999999999999"])
    joined = chance.random() < 0.5 and flag.startswith("--")
    return [*sound(chance, verb), *([f"{flag}={value}"] if joined else [flag, value])]


def no_choice(chance: random.Random, place: Path) -> list[str]:
    flag, known = chance.choice(
        [("--engine", ["auto", "native", "gymnasium", "subprocess", "envpool", "ale"]), ("--device", ["auto", "cpu", "gpu"])]
    )
    if chance.random() < 0.2:
        return ["compare", "a", "b", "--metric", unlike(chance, lambda word: word in ("iqm", "mean"), ["iqm", "mean"])]
    return [*sound(chance, chance.choice(["train", "bench"])), f"{flag}={unlike(chance, lambda word: word in known, known)}"]


def unknown_setting(chance: random.Random, place: Path) -> list[str]:
    algorithm = chance.choice(TRAINED)
    known = list(read_config_fields(algorithm))
    name = unlike(chance, lambda word: word.partition("=")[0].strip().replace("-", "_") in known, known)
    return [chance.choice(["train", "bench"]), algorithm, "FrozenLake-v1", "--set", f"{name}={chance.choice(['1', '0.5', 'x', ''])}"]


def wrong_setting(chance: random.Random, place: Path) -> list[str]:
    algorithm = chance.choice(TRAINED)
    fields = read_config_fields(algorithm)
    facts = fields[chance.choice([name for name, facts in fields.items() if facts.kind in (int, float, bool)])]
    below = [f"{bound.low - step:g}" for bound in facts.bounds for step in (1, 1e9) if hasattr(bound, "low")]
    above = [f"{bound.high + step:g}" for bound in facts.bounds for step in (1, 1e9) if hasattr(bound, "high")]
    value = chance.choice([*WRONG_VALUES[facts.kind.__name__], *below, *above])
    spelled = facts.name.replace("_", chance.choice("_-"))
    flag = ["--set", f"{spelled}={value}"] if chance.random() < 0.6 or facts.name == "total_steps" else [f"--{spelled}={value}"]
    return [chance.choice(["train", "bench"]), algorithm, "FrozenLake-v1", *flag]


def no_setting(chance: random.Random, place: Path) -> list[str]:
    text = chance.choice(
        ["", "=", "=5", " = ", "gamma", "gamma:0.9", "total_steps=5", "total-steps=1e6", "gamma 0.9", ",", "gamma;0.9", "🤖"]
    )
    return ["train", chance.choice(TRAINED), "CartPole-v1", "--set", text]


def no_environment(chance: random.Random, place: Path) -> list[str]:
    word = unlike(chance, lambda word: word in IDS or ":" in word, IDS)
    algorithm = chance.choice([*TRAINED, "planning"])
    # A word that begins with ALE/ or names a module is for other kinds of mistake.
    return chance.choice([["train", algorithm, word], ["bench", algorithm, word], ["check-env", word], ["train", "--env", word, algorithm]])


def no_module(chance: random.Random, place: Path) -> list[str]:
    name = chance.choice(
        ["no_such_module:Env-v0", "os.path:Env", "os:getcwd", ":Env", "math:", "..:x", "a b:c", "no.such.thing:Env", "json:tool", "🤖:x"]
    )
    return [chance.choice(["train", "bench"]), chance.choice(TRAINED), name]


def no_class(chance: random.Random, place: Path) -> list[str]:
    path = chance.choice([*FILES, "missing.py", "folder.py", "empty", "missing/deep.py"])
    name = f"{path}:{chance.choice(['Env', 'Missing', '', '__doc__', 'a.b', '5'])}"
    return [chance.choice(["train", "bench"]), chance.choice(TRAINED), name]


def no_algorithm(chance: random.Random, place: Path) -> list[str]:
    word = unlike(chance, lambda word: word in ALGORITHMS, list(ALGORITHMS))
    verb = chance.choice(["train", "bench"])
    return chance.choice(
        [[verb, word, "CartPole-v1"], [verb, "--algo", word, "CartPole-v1"], ["list", "settings", word], [verb, "--algo=" + word]]
    )


def too_few_or_many(chance: random.Random, place: Path) -> list[str]:
    few = [
        ["train"],
        ["train", "ppo"],
        ["train", "CartPole-v1"],
        ["bench"],
        ["check-env"],
        ["eval"],
        ["show"],
        ["resume"],
        ["plot"],
        ["compare"],
    ]
    few += [
        ["list", "settings"],
        ["train", "CartPole-v1", "ppo"],
        ["reproduce"],
        ["watch"],
        ["train", "--algo", "ppo"],
        ["train", "--env", "CartPole-v1"],
    ]
    many = [
        ["train", "ppo", "CartPole-v1"],
        ["show", "a"],
        ["info"],
        ["list", "runs"],
        ["check-env", "CartPole-v1"],
        ["bench", "dqn", "CartPole-v1"],
    ]
    if chance.random() < 0.4:
        return list(chance.choice(few))
    # An empty word after `list runs` would be an algorithm, of which none is expected either.
    return [*chance.choice(many), *chance.choices([junk for junk in JUNK if not junk.startswith("-")], k=chance.randint(1, 30))]


def no_environment_setting(chance: random.Random, place: Path) -> list[str]:
    malformed = ["", "=", "=5", "a b=1", "5=x", "x", "é è=1", "🤖=1", "a.b=1", "\x1b=1", "class", "-=1"]
    unknown = [
        "nonsense=1",
        "nonsense={[]: 1}",
        "nonsense=" + "(" * 500,
        "nonsense=" + "-" * 9000 + "1",
        "nonsense=" + "9" * 6000,
        "nonsense=1 is 1",
    ]
    unknown += ["nonsense='\\d'", "self=1", "nonsense=" + "[" * 90 + "]" * 90, "nonsense=\udcff", "nonsense=__import__('os').getcwd()"]
    verb = chance.choice([["train", "ppo"], ["bench", "dqn"], ["train", "q_learning"], ["check-env"]])
    environment = chance.choice(["CartPole-v1", "FrozenLake-v1", "Blackjack-v1", "Acrobot-v1", "probe/Counting-v0"])
    return [*verb, environment, "--env-set", chance.choice([*malformed, *unknown])]


def no_preset(chance: random.Random, place: Path) -> list[str]:
    return [
        *sound(chance, "train")[:2],
        "CartPole-v1",
        "--preset",
        unlike(chance, lambda word: word in ("none", "default"), ["none", "default"]),
    ]


def no_output(chance: random.Random, place: Path) -> list[str]:
    folder = chance.choice(["/dev/null", "/dev/null/runs", "text.txt", "text.txt/runs", "x" * 300, "x/" * 3000 + "x", "syntax.py/a/b"])
    verb = chance.choice(["train", "list", *OF_RUNS])
    if verb == "list":
        return ["list", "algos", "--output", folder]
    return [*sound(chance, verb), "--output", folder]


def no_run(chance: random.Random, place: Path) -> list[str]:
    verb = chance.choice(OF_RUNS)
    # Long enough to be no part of the name of a run.
    name = chance.choice(
        [
            "empty",
            "text.txt",
            "syntax.py",
            "/dev/null",
            "missing/run",
            "latest",
            "twins",
            "twin",
            "E/ppo",
            *[junk for junk in JUNK if len(junk) > 4],
        ]
    )
    output = chance.choice(
        [["--output", "empty"], ["--output", "missing"], []] if name in ("latest", "twin", "E/ppo") else [["--output", "twins"], []]
    )
    if name in ("twins", "twin", "E/ppo") and chance.random() < 0.5:
        output = ["--output", "twins"]
    return [verb, *[name] * (2 if verb == "compare" else 1), *output]


def broken_run(chance: random.Random, place: Path) -> list[str]:
    verb = chance.choice(OF_RUNS)
    run = f"broken/E/ppo/broken-{chance.randrange(len(NO_OBJECTS))}"
    return chance.choice([[verb, run, run], ["list", "--output", "broken"]]) if verb in ("compare", "plot") else [verb, run]


def wrong_run(chance: random.Random, place: Path) -> list[str]:
    name = chance.choice(list(WRONG_FACTS))
    number = chance.choice([*range(len(WRONG_FACTS[name])), "missing"])
    verb = chance.choice(["resume", "reproduce", "resume", "reproduce", "eval", "watch", "compare", "plot"])
    run = f"wrong/E/ppo/wrong-{name}-{number}"
    return [verb, run, *([chance.choice(["twins/E/ppo/twin-1", run])] if verb == "compare" else [])]


def wrong_files(chance: random.Random, place: Path) -> list[str]:
    number = chance.randrange(len(NO_OBJECTS))
    verb, folder = chance.choice(
        [("eval", "policy"), ("watch", "policy"), ("plot", "lines"), ("show", "lines"), ("show", "evaluated"), ("compare", "policy")]
    )
    where = {"policy": "policies", "lines": "lines", "evaluated": "evaluated"}[folder]
    run = f"{where}/E/ppo/{folder}-{number}"
    return [verb, run, *(["twins/E/ppo/twin-1"] if verb == "compare" else [])]


def wrong_form(chance: random.Random, place: Path) -> list[str]:
    """Files of a kind that is not written, flags that exclude each other, and learners that do not fit."""
    ending = chance.choice([".gif", "", ".PNG.txt", ".mp3", ".exe", "/"])
    return chance.choice(
        [
            ["watch", "no-run", "--video", f"film{ending}"],
            ["plot", "no-run", "--file", f"plot{ending}"],
            ["compare", "a", "b", "--plot", f"plot{ending}"],
            ["watch", "no-run", "--video", "a.mp4", "--window"],
            ["compare", "a", "b", "--failed-below", chance.choice(["x", "", "1,5", "--", "1e"])],
            [
                "list",
                unlike(chance, lambda word: word in ("runs", "algorithms", "environments", "presets", "settings"), ["runs", "presets"]),
            ],
            ["info", "--steps", "5"],
            ["record", "no-run", "--random-share", chance.choice(["-0.1", "1.5", "x", "nan", "inf", ""])],
            ["record", "no-run", "--episodes", "5", "--steps", "5"],
            ["record", "no-run", "--to", chance.choice(["empty", "text.txt", "twins"])],
            ["ope", "no-run"],
            ["ope", "no-run", "--data", chance.choice(["empty", "missing", "text.txt", "CartPole-v1"])],
            ["ope", "no-run", "--data", "empty", "--methods", chance.choice(["x", "", "fqe,", "pdis dr", "WIS"])],
            ["ope", "no-run", "--data", "empty", "--gamma", chance.choice(["1", "-1", "x", "2"])],
            ["train", chance.choice(FROM_DATA), chance.choice(["CartPole-v1", "Pendulum-v1", "empty", "missing/data"])],
            ["train", "awac", "Pendulum-v1", "--start-from", chance.choice(["no-run", "empty"])],
            ["train", "dqn", chance.choice(["Pendulum-v1", "MountainCarContinuous-v0"])],
            ["train", "q_learning", chance.choice(["Pendulum-v1", "MountainCarContinuous-v0"])],
            ["train", "planning", chance.choice(["CartPole-v1", "Pendulum-v1"])],
        ]
    )


KINDS: dict[str, Callable[[random.Random, Path], list[str]]] = {
    "no verb": no_verb,
    "flag before the verb": flag_before_verb,
    "unknown flag": unknown_flag,
    "value missing": value_missing,
    "no number": no_number,
    "no choice": no_choice,
    "unknown setting": unknown_setting,
    "wrong setting": wrong_setting,
    "no setting": no_setting,
    "no environment": no_environment,
    "no module": no_module,
    "no class": no_class,
    "no algorithm": no_algorithm,
    "too few or many": too_few_or_many,
    "no environment setting": no_environment_setting,
    "no preset": no_preset,
    "no output": no_output,
    "no run": no_run,
    "broken run": broken_run,
    "wrong run": wrong_run,
    "wrong files": wrong_files,
    "wrong form": wrong_form,
}
"""Every kind of mistake, equally likely."""
