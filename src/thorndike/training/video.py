"""Films of a policy: an mp4 where there is no screen, a window where there is one."""

from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np

from thorndike.errors import UserError
from thorndike.training.policy import Policy

_FPS = 30


def film(policy: Policy, make: Callable[[str], gymnasium.Env], path: Path | None, episodes: int, seed: int) -> Path | None:
    """Play episodes of ``policy`` on the environment ``make(render_mode)`` gives; returns the mp4's path, or None for a window.

    Raises ``UserError`` if the environment cannot be drawn, or the packages that write a film are missing.
    """
    environment = make("human" if path is None else "rgb_array")
    frames = []
    try:
        for episode in range(episodes):
            obs, _ = environment.reset(seed=seed + episode if episode == 0 else None)
            memory, done = None, False
            while not done:
                frames.append(_frame(environment) if path is not None else None)
                action, memory = policy.predict(obs, memory)
                obs, _, terminated, truncated, _ = environment.step(_plain(environment.action_space, action))
                done = terminated or truncated
            frames.append(_frame(environment) if path is not None else None)
        fps = int(environment.metadata.get("render_fps") or _FPS)
    finally:
        environment.close()
    return None if path is None else _write(frames, path, fps)


def _plain(space: gymnasium.Space, action: np.ndarray) -> int | np.ndarray:
    return int(action) if isinstance(space, gymnasium.spaces.Discrete) else np.asarray(action, space.dtype)


def _frame(environment: gymnasium.Env) -> np.ndarray:
    frame = environment.render()
    if not isinstance(frame, np.ndarray):
        raise UserError("this environment cannot be filmed: render() with render_mode='rgb_array' must give an array [height, width, 3]")
    return frame


def _write(frames: list[np.ndarray], path: Path, fps: int) -> Path:
    try:
        import imageio.v2 as imageio
        import imageio_ffmpeg  # noqa: F401
    except ImportError:
        raise UserError("writing a film needs two packages: pip install 'thorndike[video]'") from None
    path.parent.mkdir(parents=True, exist_ok=True)
    # Video blocks are 16 pixels wide; padding beats imageio's rescaling.
    height, width = frames[0].shape[:2]
    padding = ((0, -height % 16), (0, -width % 16), (0, 0))
    with imageio.get_writer(path, fps=fps, codec="libx264", macro_block_size=16) as writer:
        for frame in frames:
            writer.append_data(np.pad(frame, padding))
    return path
