"""From a run's directory back to what was asked for: the request in ``run.json``, and the objects it cannot hold."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from thorndike import startup
from thorndike.api.building import EnvironmentLike, Job, Request, build_job
from thorndike.environments import registry
from thorndike.errors import UserError
from thorndike.networks.network import NetworkBuilder
from thorndike.training.devices import devices_for
from thorndike.training.json_files import Json, blamed_on
from thorndike.training.machine import differences
from thorndike.training.notices import notice
from thorndike.training.run_directory import facts
from thorndike.types import Wrapper

_CODE = (".py", ".pyc", ".pyd", ".so", ".pth", ".zip")


class Objects(NamedTuple):
    """What was a Python object when the run was made, given again."""

    environment: EnvironmentLike | None = None
    wrappers: Sequence[Wrapper] | None = None
    network: NetworkBuilder | None = None


def request_in(record: Json, run: Path, objects: Objects) -> Request:
    """The request that a record holds. Raises ``UserError`` if it cannot be, or an object is needed again."""
    request = Request(**{field: record[field] for field in Request._fields if field in record})  # type: ignore[arg-type]
    if record["network"] == "user" and objects.network is None:
        raise UserError(f"{run} was trained with a network of your own; go on in Python, with network=...")
    if record["environment_object"] and objects.environment is None:
        raise UserError(f"{run} was trained on an environment object; go on with it in Python, with environment=...")
    if objects.wrappers is None and not all(request.wrappers):
        raise UserError(f"{run} was trained with wrappers that hold your own functions; go on in Python, with wrappers=[...]")
    if objects.environment is None:
        refuse_code(run, request.environment)
    return request


def rebuild(record: Json, request: Request, run: Path, objects: Objects, env_timeout: float | None = None) -> Job:
    """The request made ready to run, on the device and with the number of processors it was made with.

    One notice says what differs here. Raises ``UserError``.
    """
    processors = str(record["processors"])
    if request.engine == "native":
        startup.count_cores_as_devices(devices_for(request.seeds, startup.cores()))
    device = startup.choose_device(str(record["device"]), False, int(processors) if processors.isascii() and processors.isdigit() else None)
    found = differences(record, {**facts(), "device": device})
    if found:
        notice(f"the last bits may differ from those that {run} had: {'; '.join(found)}")
    with blamed_on(run / "run.json"):
        choice = registry.resolve(
            request.environment if objects.environment is None else objects.environment,
            engine=request.engine,
            env_kwargs=request.env_kwargs,
            max_episode_steps=request.max_episode_steps,
        )
        return build_job(request, choice, objects.wrappers, objects.network, env_timeout, devices=startup.device_count(None))


def refuse_code(run: Path, environment: str) -> None:
    """Raises ``UserError`` if the environment will be imported and the run's directory holds code: a run cannot bring its own."""
    files: Iterable[Path] = sorted(run.rglob("*")) if ":" in environment else ()
    for path in files:
        if path.suffix in _CODE:
            raise UserError(f"{path} is code, which a run's directory does not hold: move it elsewhere if you trust it")
