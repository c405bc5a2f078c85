"""Films of a policy: an mp4 where there is no screen, a window where there is one."""

import warnings
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
    frames: list[np.ndarray] = []
    try:
        for episode in range(episodes):
            obs, _ = environment.reset(seed=seed + episode if episode == 0 else None)
            memory, done = None, False
            while not done:
                if path is not None:
                    frames.append(frame_of(environment))
                action, memory = policy.predict(obs, memory)
                obs, _, terminated, truncated, _ = environment.step(_plain(environment.action_space, action))
                done = terminated or truncated
            if path is not None:
                frames.append(frame_of(environment))
        fps = int(environment.metadata.get("render_fps") or _FPS)
    finally:
        environment.close()
    return None if path is None else write_film(frames, path, fps)


def _plain(space: gymnasium.Space, action: np.ndarray) -> int | np.ndarray:
    return int(action) if isinstance(space, gymnasium.spaces.Discrete) else np.asarray(action, space.dtype)


def frame_of(environment: gymnasium.Env) -> np.ndarray:
    """What an environment draws. Raises ``UserError`` if it is no picture."""
    frame = environment.render()
    if not isinstance(frame, np.ndarray):
        raise UserError("this environment cannot be filmed: render() with render_mode='rgb_array' must give an array [height, width, 3]")
    return frame


def write_film(frames: list[np.ndarray], path: Path, fps: int) -> Path:
    """Pictures ``[height, width, 3]`` as an mp4. Raises ``UserError`` if the package that writes it is missing."""
    try:
        from imageio_ffmpeg import write_frames
    except ImportError:
        raise UserError("writing a film needs a package more: pip install 'thorndike[video]'") from None
    path.parent.mkdir(parents=True, exist_ok=True)
    # Video blocks are 16 pixels wide; repeating the edge beats rescaling.
    height, width = frames[0].shape[:2]
    padding = ((0, -height % 16), (0, -width % 16), (0, 0))
    size = (width + -width % 16, height + -height % 16)
    with warnings.catch_warnings():
        # The encoder is a child process, started by fork; it runs no Python, so JAX's threads are in no danger.
        warnings.filterwarnings("ignore", message="os.fork", category=RuntimeWarning)
        writer = write_frames(str(path), size, fps=fps, codec="libx264", macro_block_size=16)
        writer.send(None)
        for frame in frames:
            writer.send(np.ascontiguousarray(np.pad(frame, padding, mode="edge"), np.uint8))
        writer.close()
    return path
