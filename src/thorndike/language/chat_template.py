"""Chat templates: Jinja programs that come with a model, run in the sandbox and with the helpers that transformers gives them."""

import json
from collections.abc import Mapping, Sequence
from datetime import datetime
from functools import lru_cache
from typing import NoReturn, TypeAlias

import jinja2
import jinja2.ext
import jinja2.nodes
import jinja2.parser
from jinja2.sandbox import ImmutableSandboxedEnvironment

from thorndike.errors import UserError

Message: TypeAlias = Mapping[str, object]
"""``{"role": "user", "content": "..."}``."""


def render(template: str, messages: Sequence[Message], special_texts: Mapping[str, str], prompt: bool) -> str:
    """The text of a conversation. Raises ``UserError`` for a template that is no Jinja, or that refuses the conversation."""
    try:
        return _compiled(template).render(
            messages=list(messages), tools=None, documents=None, add_generation_prompt=prompt, **special_texts
        )
    except jinja2.TemplateError as error:
        raise UserError(f"the chat template refuses this conversation: {error}") from error
    except (TypeError, ValueError, KeyError) as error:
        raise UserError(f"the chat template cannot show this conversation: {type(error).__name__}: {error}") from error


class _Generation(jinja2.ext.Extension):
    """``{% generation %} ... {% endgeneration %}`` marks what the assistant says; the text is as if it were not there."""

    def parse(self, parser: jinja2.parser.Parser) -> list[jinja2.nodes.Node]:
        """The statements inside."""
        next(parser.stream)
        return parser.parse_statements(("name:endgeneration",), drop_needle=True)


_Generation.tags = {"generation"}


class _Namespace(jinja2.utils.Namespace):
    """Jinja's, but names that begin with an underscore are refused: they would reach into Python."""

    def __setitem__(self, name: str, value: object) -> None:
        if name.startswith("_"):
            raise jinja2.exceptions.SecurityError(f"a chat template may not set {name!r}")
        super().__setitem__(name, value)


def _namespace(*pairs: Mapping[str, object], **named: object) -> _Namespace:
    made = _Namespace()
    for name, value in dict(*pairs, **named).items():
        made[name] = value
    return made


def _dictionary(*pairs: Mapping[str, object], **named: object) -> dict[str, object]:
    return dict(*pairs, **named)


def _raise(message: str) -> NoReturn:
    raise jinja2.exceptions.TemplateError(message)


def _now(pattern: str) -> str:
    return datetime.now().strftime(pattern)


def _to_json(
    value: object,
    ensure_ascii: bool = False,
    indent: int | None = None,
    separators: tuple[str, str] | None = None,
    sort_keys: bool = False,
) -> str:
    """Jinja's own filter would write ``<`` as an escape."""
    return json.dumps(value, ensure_ascii=ensure_ascii, indent=indent, separators=separators, sort_keys=sort_keys)


@lru_cache(maxsize=64)
def _compiled(template: str) -> jinja2.Template:
    sandbox = ImmutableSandboxedEnvironment(trim_blocks=True, lstrip_blocks=True, extensions=[_Generation, jinja2.ext.loopcontrols])
    sandbox.filters["tojson"] = _to_json
    sandbox.globals |= {"raise_exception": _raise, "strftime_now": _now, "namespace": _namespace, "dict": _dictionary}
    return sandbox.from_string(template)
