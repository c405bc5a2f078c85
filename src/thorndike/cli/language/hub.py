"""Models by their names on the Hugging Face hub: fetched once, into that package's cache, by whoever has the package."""

import re
from pathlib import Path

from thorndike.errors import UserError

_NAME = re.compile(r"\w[\w.-]*/\w[\w.-]*", re.ASCII)
_READ = ("*.json", "*.safetensors", "*.jinja")


def model_folder(model: Path) -> Path:
    """The folder of a model that is one, or that has a name of the form ``owner/name``; anything else as it is.

    Raises ``UserError`` for a name where the package is missing, the hub has no such model, or there is no way to it.
    """
    name = str(model)
    # Beside a folder that is there a name is a mistyped path, with which nobody else is to be troubled.
    if model.exists() or model.parent.is_dir() or not _NAME.fullmatch(name):
        return model
    try:
        from huggingface_hub import snapshot_download
        from huggingface_hub.errors import HfHubHTTPError, HFValidationError, RepositoryNotFoundError
    except ModuleNotFoundError:
        raise UserError(f"{name} is no folder; to fetch a model of that name from the hub: pip install 'thorndike[hub]'") from None
    try:
        return Path(str(snapshot_download(name, allow_patterns=list(_READ), ignore_patterns=["*/*"])))
    except (RepositoryNotFoundError, HFValidationError) as error:
        raise UserError(f"{name} is no folder, and no model on the hub that may be read without more rights; check its name") from error
    except HfHubHTTPError as error:
        raise UserError(f"the hub does not give {name}: {' '.join(str(error).split())[:200]}") from error
    except OSError as error:
        raise UserError(
            f"{name} is no folder, and the hub cannot be reached to fetch it: give a folder where there is no network"
        ) from error
