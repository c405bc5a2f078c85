"""The settings of an algorithm, read from the source text of its file: neither JAX nor the algorithm is imported for it."""

import ast
import builtins
import operator
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path

from thorndike.algorithms import ALGORITHMS
from thorndike.errors import UserError
from thorndike.settings import AtLeast, Between, FieldFacts, MoreThan, OneOf, facts_of
from thorndike.suggestions import did_you_mean


@lru_cache(maxsize=64)
def read_config_fields(algorithm: str) -> Mapping[str, FieldFacts]:
    """The settings of an algorithm by name, read from ``algorithms/<name>.py`` without importing it.

    Raises UserError for an algorithm that does not exist.
    """
    if algorithm not in ALGORITHMS:
        raise UserError(f"there is no algorithm '{algorithm}'{did_you_mean(algorithm, ALGORITHMS)}")
    module = ALGORITHMS[algorithm].module.removeprefix("thorndike.").replace(".", "/")
    return fields_in_source((Path(__file__).parent / f"{module}.py").read_text(encoding="utf-8"))


def fields_in_source(source: str) -> dict[str, FieldFacts]:
    """The fields of the class ``Config`` in a Python source text, by name and in order."""
    tree = ast.parse(source)
    config = next(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == "Config")
    return {facts.name: facts for facts in _class_fields(config, _Names(tree), source)}


def _class_fields(node: ast.ClassDef, names: "_Names", source: str) -> Iterable[FieldFacts]:
    lines = source.split("\n")
    for statement, follower in zip(node.body, [*node.body[1:], None], strict=True):
        if not isinstance(statement, ast.AnnAssign) or not isinstance(statement.target, ast.Name):
            continue
        default = None if statement.value is None else _text_of(statement.value, lines)
        # Columns count bytes of UTF-8.
        line = lines[(statement.end_lineno or statement.lineno) - 1].encode()
        comment = line[statement.end_col_offset or 0 :].decode().strip().lstrip("# ")
        if not comment and isinstance(follower, ast.Expr) and isinstance(follower.value, ast.Constant):
            comment = str(follower.value.value).strip().partition("\n")[0]
        yield facts_of(statement.target.id, names.value_of(statement.annotation), default, comment)


def _text_of(node: ast.expr, lines: Sequence[str]) -> str:
    """An expression as it stands in the source: `ast.get_source_segment`, which would cut the whole source into lines each time."""
    first, last = node.lineno - 1, (node.end_lineno or node.lineno) - 1
    rows = [line.encode() for line in lines[first : last + 1]]
    rows[-1] = rows[-1][: node.end_col_offset]
    return b"\n".join([rows[0][node.col_offset :], *rows[1:]]).decode()


_TYPES: dict[str, object] = {kind.__name__: kind for kind in (int, float, bool, str)}
_BOUNDS: dict[str, Callable[..., object]] = {bound.__name__: bound for bound in (Between, AtLeast, MoreThan, OneOf)}
_GENERICS = {"Annotated": vars(typing)["Annotated"], "Literal": vars(typing)["Literal"], "tuple": vars(builtins)["tuple"]}
_OPERATORS = {ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv, ast.Pow: operator.pow}


class _Names:
    """What the names of a module mean in an annotation, found in its text: ``object``, which admits everything, if that is not enough."""

    def __init__(self, tree: ast.Module) -> None:
        self._assigned: dict[str, ast.expr] = {}
        self._imported: dict[str, str] = {}
        for node in tree.body:
            if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                self._assigned[ast.unparse(node.targets[0] if isinstance(node, ast.Assign) else node.target)] = node.value
            elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("thorndike."):
                self._imported |= {alias.name: str(node.module) for alias in node.names}

    def value_of(self, node: ast.expr) -> object:
        """The value of an expression made of types, bounds, literals and names of them."""
        match node:
            case ast.Constant(value):
                return value
            case ast.Name(name):
                return self._look_up(name)
            case ast.Tuple(elements) | ast.List(elements) | ast.Set(elements):
                return tuple(self.value_of(element) for element in elements)
            case ast.Dict(keys):
                return tuple(self.value_of(key) for key in keys if key is not None)
            case ast.UnaryOp(ast.USub(), operand):
                number = self.value_of(operand)
                return -number if isinstance(number, int | float) else object
            case ast.BinOp(left, sign, right):
                return _combine(self.value_of(left), sign, self.value_of(right))
            case ast.Subscript(ast.Name(name), index) if name in _GENERICS:
                return _GENERICS[name][self.value_of(index)]
            case ast.Call(ast.Name(name), arguments) if name in _BOUNDS:
                values = [part for argument in arguments for part in self._unpacked(argument)]
                return object if object in values else _BOUNDS[name](*values)
        return object

    def _unpacked(self, node: ast.expr) -> tuple[object, ...]:
        value = self.value_of(node.value if isinstance(node, ast.Starred) else node)
        return value if isinstance(node, ast.Starred) and isinstance(value, tuple) else (value,)

    def _look_up(self, name: str) -> object:
        if name in self._assigned:
            return self.value_of(self._assigned[name])
        path = Path(__file__).parent.joinpath(*self._imported.get(name, "").split(".")[1:]).with_suffix(".py")
        if name in self._imported and path.is_file():
            return _Names(ast.parse(path.read_text(encoding="utf-8")))._look_up(name)
        return _TYPES.get(name, object)


def _combine(left: object, sign: ast.operator, right: object) -> object:
    if isinstance(sign, ast.BitOr):
        return operator.or_(left, right)
    if isinstance(left, int | float) and isinstance(right, int | float) and type(sign) in _OPERATORS:
        return _OPERATORS[type(sign)](left, right)
    return object
