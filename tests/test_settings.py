"""Settings are checked in the same words whether they stand in a Config or come as text."""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import pytest

from thorndike.algorithms import ALGORITHMS
from thorndike.config_fields import fields_in_source, read_config_fields
from thorndike.errors import UserError
from thorndike.functional.schedules import schedule
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check, parse_settings


@dataclass(frozen=True)
class Config:
    """Settings of every kind that an algorithm may have."""

    total_steps: int
    gamma: Annotated[float, Between(0, 1)] = 0.99
    learning_rate: Annotated[float | str, AtLeast(0)] = 3e-4
    n_steps: Annotated[int, AtLeast(1)] = 128
    scale: Annotated[float, MoreThan(0)] = 1.0
    clip: Annotated[float | None, AtLeast(0)] = None
    hidden: Annotated[tuple[int, ...], AtLeast(1)] = (64, 64)
    activation: Annotated[str, OneOf("relu", "tanh")] = "tanh"
    variant: Literal["q", "sarsa"] = "q"
    normalize: bool = True

    def __post_init__(self) -> None:
        check(self)


SOURCE = '''
from typing import Annotated, Literal
from thorndike.networks.torso import ACTIVATIONS
Variant = Literal["q", "sarsa"]
LIMIT = 2**4
class Helper: ...
@dataclass(frozen=True)
class Config:
    """A docstring."""
    total_steps: int  # environment steps
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount (gamma)
    learning_rate: Annotated[float | str, AtLeast(0)] = 3e-4
    """Step size (alpha).

    More about it."""
    n_steps: Annotated[int, AtLeast(1)] = 128
    hidden: Annotated[tuple[int, ...], AtLeast(1)] = (64, 64)
    variant: Variant = "q"
    capacity: Annotated[int, AtLeast(-LIMIT)] = LIMIT
    clip: Annotated[float | None, MoreThan(0)] = None
    normalize: bool = True
    activation: Annotated[str, OneOf("relu", "tanh")] = "tanh"
    torso: Annotated[str, OneOf(*ACTIVATIONS)] = "relu"
    late: Annotated[int, AtLeast(unknown())] = 1
    network: Network = MLP
    def __post_init__(self): check(self)
'''
FIELDS = fields_in_source(SOURCE)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("gamma", 1.5, "gamma = 1.5, but it must be between 0 and 1"),
        ("gamma", float("nan"), "gamma = nan, but it must be between 0 and 1"),
        ("gamma", "high", "gamma = 'high', but it must be a number"),
        ("gamma", True, "gamma = True, but it must be a number"),
        ("n_steps", 0, "n_steps = 0, but it must be at least 1"),
        ("n_steps", 1.5, "n_steps = 1.5, but it must be a whole number"),
        ("scale", 0.0, "scale = 0.0, but it must be more than 0"),
        ("clip", -1.0, "clip = -1.0, but it must be at least 0"),
        ("hidden", (64, 0), "hidden = (64, 0), but it must be at least 1"),
        ("hidden", (64, 0.5), "hidden = (64, 0.5), but it must be a list such as 64,64"),
        ("activation", "gelu", "activation = gelu, but it must be one of relu, tanh"),
        ("variant", "dyna", "variant = 'dyna', but it must be one of q, sarsa"),
        ("normalize", 1, "normalize = 1, but it must be true or false"),
        ("learning_rate", "fast", "learning_rate = 'fast', but it must be a number or a schedule such as linear(1e-3, 0)"),
        ("learning_rate", "linear(1e-3, -1)", "learning_rate = linear(1e-3, -1), but it must be at least 0"),
    ],
)
def test_config_rejects_a_wrong_value_with_the_numbers(name, value, message):
    with pytest.raises(UserError) as raised:
        Config(100, **{name: value})
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("gamma", 1),
        ("gamma", 0),
        ("gamma", np.float32(0.5)),
        ("n_steps", np.int64(3)),
        ("clip", 0.2),
        ("hidden", ()),
        ("learning_rate", "linear(1e-3, 0)"),
        ("learning_rate", "lin_3e-4"),
        ("learning_rate", "cosine(1, 0, 0.5)"),
        ("variant", "sarsa"),
    ],
)
def test_config_takes_a_right_value(name, value):
    assert getattr(Config(100, **{name: value}), name) == value


@pytest.mark.parametrize(
    "text",
    [
        "linear(1e-3, 0)",
        " linear(1, 0, 0.1) ",
        "lin_1e-3",
        "cosine(1, 0)",
        "exponential(1, 0.1)",
        "0.5",
        "exponential(1, 0)",
        "linear(1)",
        "linear(1, 2, 3, 4)",
        "linear(1, 0, 2)",
        "linear(1, x)",
        "step(1, 0)",
        "lin_x",
        "fast",
        "",
    ],
)
def test_the_schedules_admitted_here_are_those_that_can_be_built(text):
    try:
        schedule(text)
        built = True
    except UserError:
        built = False
    try:
        Config(100, learning_rate=text)
        admitted = True
    except UserError:
        admitted = False
    assert admitted == built


def test_the_message_names_the_algorithm_by_its_file():
    with pytest.raises(UserError, match=r"^test_settings: gamma"):
        Config(100, gamma=2.0)


def test_source_is_read_with_types_bounds_defaults_and_comments():
    assert list(FIELDS)[:3] == ["total_steps", "gamma", "learning_rate"]
    assert FIELDS["total_steps"].default is None
    assert FIELDS["gamma"] == ("gamma", float, (Between(0, 1),), "0.99", "discount (gamma)")
    assert FIELDS["learning_rate"].comment == "Step size (alpha)."
    assert FIELDS["learning_rate"].kind == float | str
    assert FIELDS["hidden"].kind == tuple[int, ...]
    assert FIELDS["variant"].kind == Literal["q", "sarsa"]
    assert FIELDS["capacity"].bounds == (AtLeast(-16),)
    assert FIELDS["activation"].bounds == (OneOf("relu", "tanh"),)
    assert FIELDS["learning_rate"].default == "3e-4"


def test_names_from_other_files_of_thorndike_are_followed():
    assert "tanh" in FIELDS["torso"].bounds[0].choices


def test_what_cannot_be_read_admits_everything():
    assert FIELDS["late"].bounds == ()
    assert FIELDS["network"].kind is object


def test_source_and_class_declare_the_same():
    for name in ("gamma", "learning_rate", "n_steps", "hidden", "activation"):
        assert FIELDS[name].kind == Config.__annotations__[name].__origin__
        assert FIELDS[name].bounds == Config.__annotations__[name].__metadata__


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("gamma=0.9", 0.9),
        ("gamma=1", 1.0),
        (" gamma = .5 ", 0.5),
        ("n_steps=1_000", 1000),
        ("n-steps=1e3", 1000),
        ("learning_rate=linear(1e-3, 0)", "linear(1e-3, 0)"),
        ("learning_rate=1e-3", 1e-3),
        ("hidden=32,16", (32, 16)),
        ("hidden=[32]", (32,)),
        ("hidden=()", ()),
        ("clip=none", None),
        ("clip=0.2", 0.2),
        ("normalize=false", False),
        ("normalize=On", True),
        ("variant=sarsa", "sarsa"),
        ("capacity=-3", -3),
    ],
)
def test_text_becomes_a_value_of_the_declared_type(text, value):
    (parsed,) = parse_settings([text], FIELDS, "ppo").values()
    assert parsed == value
    assert type(parsed) is type(value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("gama=0.9", "ppo has no setting 'gama'; did you mean 'gamma'?"),
        ("lr=0.1", "ppo has no setting 'lr'; did you mean 'learning_rate'?"),
        ("gamma", "--set gamma: expected NAME=VALUE, for example --set gamma=0.99"),
        ("=3", "--set =3: expected NAME=VALUE"),
        ("gamma=2", "ppo: gamma = 2.0, but it must be between 0 and 1 (default 0.99)"),
        ("gamma=", "ppo: gamma = '', but it must be a number"),
        ("n_steps=1.5", "ppo: n_steps = '1.5', but it must be a whole number (default 128)"),
        ("n_steps=inf", "ppo: n_steps = 'inf', but it must be a whole number"),
        ("normalize=perhaps", "ppo: normalize = 'perhaps', but it must be true or false"),
        ("hidden=64,x", "ppo: hidden = '64,x', but it must be a list such as 64,64"),
        ("clip=0", "ppo: clip = 0.0, but it must be more than 0"),
    ],
)
def test_a_wrong_text_is_refused_in_one_line(text, message):
    with pytest.raises(UserError) as raised:
        parse_settings([text], FIELDS, "ppo")
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_name_far_from_everything_lists_what_is_known():
    with pytest.raises(UserError, match="known: activation, capacity"):
        parse_settings(["zzzzzzzz=1"], FIELDS, "ppo")


def test_of_a_name_given_twice_the_last_counts():
    assert parse_settings(["gamma=0.1", "gamma=0.2"], FIELDS, "ppo") == {"gamma": 0.2}


def test_an_unknown_algorithm_gets_a_suggestion():
    with pytest.raises(UserError, match="there is no algorithm 'pppo'; did you mean 'ppo'"):
        read_config_fields("pppo")


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_declares_its_steps_and_a_comment_for_each_setting(algorithm):
    known = read_config_fields(algorithm)
    assert ("total_steps" in known) == (algorithm != "planning")
    assert [name for name, facts in known.items() if not facts.comment] == []
