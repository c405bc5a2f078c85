"""Code of the user's, found by ``module:attribute`` or ``path/to/file.py:attribute``. Whatever goes wrong there is one line."""

import importlib
import importlib.util
import sys
import traceback
from pathlib import Path
from types import ModuleType

from thorndike.errors import UserError


def attribute_in_file(name: str) -> tuple[Path, str] | None:
    """The parts of ``path/to/file.py:attribute``, or None if `name` has not that form."""
    path, _, attribute = name.rpartition(":")
    return (Path(path), attribute) if path.endswith(".py") else None


def lasting_name(name: str) -> str:
    """What a file defines by the file's absolute path, so that its run finds it from every folder; other names as they are."""
    file, _, attribute = name.rpartition(":")
    return f"{Path(file).absolute()}:{attribute}" if file.endswith(".py") and Path(file).is_file() else name


def load_file(path: Path, what: str) -> ModuleType:
    """The module in a file, imported once. Raises UserError if there is none, or it cannot be imported; ``what`` it should define."""
    if not path.is_file():
        raise UserError(f"there is no file {path}: give the path of the file that defines {what}")
    name = f"thorndike_user_{path.stem}"
    known = sys.modules.get(name)
    if known is not None and known.__file__ == str(path.resolve()):
        return known
    spec = importlib.util.spec_from_file_location(name, path.resolve())
    if spec is None or spec.loader is None:
        raise UserError(f"{path} is not a Python file: give the path of the file that defines {what}")
    module = importlib.util.module_from_spec(spec)
    # Registered so that the class can be pickled and copied.
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        raise UserError(f"{path} cannot be imported: {type(error).__name__}: {one_line(error)}") from error
    return module


def import_module(module: str, name: str, form: str) -> ModuleType:
    """The module of ``module:attribute``. Raises UserError if it cannot be imported; ``form`` is the other way to name what is wanted."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise UserError(f"cannot import {module} of {name}: {one_line(error)}; install it, or give {form}") from error
    except (Exception, SystemExit) as error:
        # Whatever a module raises, or its name, is about what was asked for.
        raise UserError(f"{module} of {name} cannot be imported: {type(error).__name__}: {one_line(error)}") from error


def place_in(file: Path | None, error: BaseException) -> str:
    """`` (FILE, line N)``: the last line of a file that an error came through; nothing where it came through none of the file's."""
    frames = [] if file is None else [each for each in traceback.extract_tb(error.__traceback__) if Path(each.filename) == file]
    return f" ({file}, line {frames[-1].lineno})" if frames else ""


def one_line(error: BaseException) -> str:
    """What an error says, without line breaks."""
    return " ".join(str(error).split())
