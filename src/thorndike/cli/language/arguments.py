"""Arguments that the verbs of language models share; nothing heavy is imported for them."""

import argparse
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from thorndike.cli.parser import Parser, at_least_zero, positive_whole
from thorndike.config_fields import fields_in_source
from thorndike.errors import UserError
from thorndike.settings import FieldFacts, describe_kind, parse_settings
from thorndike.startup import choose_device, cores, count_cores_as_devices, device_count, prepare_large_steps

Config = TypeVar("Config")
DEVICES = ("auto", "cpu", "gpu")
DTYPES = ("float32", "bfloat16")
_LARGE = 64 * 2**20
"""Bytes of parameters above which a model runs on whatever JAX finds fastest, on all processors."""


def add_model_argument(parser: Parser) -> None:
    """The model's folder, and the device."""
    parser.add_argument("model", metavar="MODEL", type=Path, help="a folder as save_pretrained writes it, or owner/name on the hub")
    parser.add_argument("--adapter", metavar="DIR", type=Path, help="a LoRA adapter in PEFT's format, merged into the model")
    add_device_argument(parser)


def add_device_argument(parser: Parser) -> None:
    """Where it is computed."""
    parser.add_argument("--device", choices=DEVICES, default="auto", help="where it is computed (default: chosen by the model's size)")


def add_precision_arguments(parser: Parser) -> None:
    """In what precision it is computed, and how many devices share it."""
    help_ = "of activations; parameters stay in float32 while they are learnt (default: the model's own)"
    parser.add_argument("--dtype", choices=DTYPES, help=help_)
    sharing = "how many devices (a CPU's cores) share every batch's rows (default: all accelerators; on a CPU 1)"
    parser.add_argument("--devices", type=positive_whole, metavar="N", help=sharing)


def add_sampling_arguments(parser: Parser, new_tokens: int) -> None:
    """How tokens are chosen."""
    parser.add_argument("--temperature", type=at_least_zero, default=1.0, metavar="T", help="0: always the likeliest token (default: 1)")
    parser.add_argument("--top-k", type=_whole_at_least_zero, default=0, metavar="K", help="among the K likeliest; 0: all (default: 0)")
    parser.add_argument(
        "--top-p", type=at_least_zero, default=1.0, metavar="P", help="among the likeliest that make up P together (default: 1)"
    )
    parser.add_argument("--max-new-tokens", type=positive_whole, default=new_tokens, metavar="N", help=f"at most (default: {new_tokens})")


def add_ignore_eos_argument(parser: Parser) -> None:
    """Whether texts end."""
    parser.add_argument("--ignore-eos", action="store_true", help="never choose a stop token: every text goes on to --max-new-tokens")


def add_settings_argument(parser: Parser) -> None:
    """``--set NAME=VALUE``."""
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="settings", help="a setting; may be repeated")


def given_settings(texts: list[str], module: str) -> dict[str, object]:
    """The settings of ``language/<module>.py`` that were given. Raises ``UserError``, before anything heavy is imported."""
    return parse_settings(texts, known_settings(module), module)


def configured(config_class: Callable[..., Config], settings: Mapping[str, object]) -> Config:
    """A Config with the settings that were given."""
    return config_class(**settings)


def known_settings(module: str) -> Mapping[str, FieldFacts]:
    """The fields of the Config in ``language/<module>.py``, read from its source."""
    source = Path(__file__).parents[2] / "language" / f"{module}.py"
    return fields_in_source(source.read_text(encoding="utf-8"))


def settings_in_words(module: str) -> str:
    """The settings as lines of a verb's help."""
    facts = known_settings(module).values()
    return "\n".join(f"  {each.name} = {each.default}  {each.comment or describe_kind(each.kind)}" for each in facts)


def prepare_device(device: str, model: Path | None, devices: int | None = None) -> None:
    """Choose the device by the size of a model's files. Raises ``UserError`` where there is no model, or no such device.

    A CPU then counts as ``devices``, at most as many as it has cores, with a thread each.
    """
    large = False
    if model is not None:
        if not (model / "config.json").is_file():
            raise UserError(f"{model} is no model: it has no config.json; give a folder as transformers' save_pretrained writes it")
        large = sum(path.stat().st_size for path in model.glob("*.safetensors")) > _LARGE
    prepare_large_steps()
    number = min(devices or 1, cores())
    count_cores_as_devices(number)
    choose_device(device, large, number if number > 1 else None)


@contextmanager
def sharing(devices: int | None) -> Iterator[None]:
    """Let the devices that there are, at most so many, share the rows of batches."""
    from thorndike.training.devices import sharing_rows

    with sharing_rows(device_count(devices)):
        yield


def _whole_at_least_zero(text: str) -> int:
    if not text.isdecimal() or not text.isascii():
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 0; got '{text}'")
    return int(text)
