"""Which contestants run in which task, and what is claimed of them. One place: the driver and the tables read it."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Contestant:
    """One process: its name in the tables and its command; ``{...}`` is filled in by the driver (``run.py``)."""

    name: str
    command: tuple[str, ...]
    environment: dict[str, str] = field(default_factory=dict)
    """Variables on top of those all contestants share."""
    prepare: bool = False
    """Whether one run ahead, not counted, fills the caches."""
    pins_itself: bool = False
    """Whether the command is a watcher that puts the contestant on the core itself and stays off it."""
    note: str = ""


@dataclass(frozen=True)
class Claim:
    """``of / versus >= at_least`` in steps per CPU-second; or, without ``versus``, ``of``'s ``measure`` <= ``at_most``."""

    of: str
    versus: str | None = None
    at_least: float | None = None
    measure: str = "steps_per_cpu_s"
    at_most: float | None = None


@dataclass(frozen=True)
class Task:
    """A group of contestants that alternate."""

    name: str
    title: str
    kind: str
    """``rate``, ``threshold`` or ``startup``: which table it gets."""
    settings: str
    contestants: tuple[Contestant, ...]
    claims: tuple[Claim, ...]


def peer(name: str, script: str, *arguments: str, note: str = "", **environment: str) -> Contestant:
    """A contestant from ``benchmarks/peers/``, run by the peers' Python."""
    command = ("{peers}", f"benchmarks/peers/{script}", *arguments, "--seed", "{seed}")
    return Contestant(name, command, environment, prepare=bool(environment), note=note)


def thorndike(name: str, task: str, *arguments: str) -> Contestant:
    """Thorndike's contestant of a rate task, through the public API."""
    command = ("{python}", "benchmarks/thorndike_rate.py", task, *arguments, "--seed", "{seed}")
    return Contestant(name, command, {"XDG_CACHE_HOME": "{fresh_cache}"})


def thorndike_threshold(name: str, cache: str, prepare: bool, note: str) -> Contestant:
    """``thorndike train ppo CartPole-v1`` as a user types it, watched from outside."""
    command = ("{python}", "benchmarks/thorndike_threshold.py", "--core", "{core}", "--seed", "{seed}")
    return Contestant(name, command, {"XDG_CACHE_HOME": cache}, prepare=prepare, pins_itself=True, note=note)


def command(name: str, *words: str) -> Contestant:
    """A command whose start-up is measured from outside."""
    return Contestant(name, words, {"XDG_CACHE_HOME": "{shared_cache}"})


TASKS = (
    Task(
        "ppo",
        "PPO on CartPole-v1, equal settings",
        "rate",
        "4 environments x 128 steps, 4 epochs of 4 minibatches of 128, actor and critic 64x64 tanh apart, Adam 2.5e-4, gamma 0.99, "
        "lambda 0.95, clip 0.2, entropy 0.01, value 0.5, gradient norm 0.5",
        (
            thorndike("Thorndike", "ppo"),
            peer("rejax", "rejax_ppo.py"),
            peer("SBX", "sbx_ppo.py"),
            peer("Stable-Baselines3", "sb3_ppo.py"),
        ),
        (Claim("Thorndike", "Stable-Baselines3", 45), Claim("Thorndike", "rejax", 1.4)),
    ),
    Task(
        "dqn",
        "DQN on CartPole-v1, equal settings",
        "rate",
        "10 environments, replay of 10,000, batch 128, one update each 10 environment steps, 120-84 relu, hard target update each 500 "
        "steps, Adam 2.5e-4, epsilon to 0.05 over half the run",
        (
            thorndike("Thorndike", "dqn"),
            peer("rejax", "rejax_dqn.py"),
            peer("SBX", "sbx_dqn.py", note="its network is 120-120: it takes one width for both layers"),
            peer("Stable-Baselines3", "sb3_dqn.py"),
        ),
        (Claim("Thorndike", "Stable-Baselines3", 15), Claim("Thorndike", "rejax", 1.5)),
    ),
    Task(
        "q_learning",
        "Tabular Q-learning on FrozenLake-v1",
        "rate",
        "4x4, slippery, alpha 0.1, gamma 0.99, epsilon 1 to 0.1 over half the run; steps of all seeds together",
        (
            thorndike("Thorndike (1 seed)", "q_learning", "--seeds", "1"),
            thorndike("Thorndike (64 seeds)", "q_learning", "--seeds", "64", "--steps", "200000"),
            peer("plain Python (Q in lists)", "python_q_learning.py", "--table", "lists"),
            peer("plain Python (Q in NumPy)", "python_q_learning.py", "--table", "numpy"),
        ),
        tuple(
            Claim(ours, plain, ratio)
            for plain in ("plain Python (Q in NumPy)", "plain Python (Q in lists)")
            for ours, ratio in (("Thorndike (1 seed)", 50), ("Thorndike (64 seeds)", 200))
        ),
    ),
    Task(
        "gymnasium",
        "PPO on a plain Gymnasium environment",
        "rate",
        "Gymnasium's own CartPole-v1 in Python (Thorndike: `--engine gymnasium`; Stable-Baselines3: DummyVecEnv), 8 environments x 128 "
        "steps, 4 epochs of 4 minibatches of 256, the rest as in PPO above",
        (thorndike("Thorndike", "gymnasium"), peer("Stable-Baselines3", "sb3_ppo_gymnasium.py")),
        (Claim("Thorndike", "Stable-Baselines3", 3),),
    ),
    *(
        Task(
            name,
            f"{name.upper()} on HalfCheetah-v5, equal settings",
            "rate",
            "one environment, one update of every network an environment step, 256x256, batch 256, replay of 100,000",
            (
                thorndike("Thorndike", name),
                peer("SBX", "sbx_continuous.py", name),
                peer("Stable-Baselines3", "sb3_continuous.py", name),
            ),
            (Claim("Thorndike", "Stable-Baselines3", 3.5), Claim("Thorndike", "SBX", 1.6)),
        )
        for name in ("sac", "td3")
    ),
    *(
        Task(
            f"minatar_{name}",
            f"{name.upper()} on MinAtar Breakout, equal settings",
            "rate",
            settings + ", a perceptron of 64x64 on the flattened board",
            (thorndike("Thorndike", f"minatar_{name}"), peer("rejax", f"rejax_{name}.py", "--environment", "Breakout-MinAtar")),
            (Claim("Thorndike", "rejax", 1.5),),
        )
        for name, settings in (
            ("ppo", "64 environments x 128 steps, 4 epochs of 4 minibatches of 2,048, the rest as in PPO on CartPole-v1"),
            ("dqn", "10 environments, batch 128, one update each 10 environment steps, the rest as in DQN on CartPole-v1"),
        )
    ),
    Task(
        "threshold",
        "CartPole-v1 from process start to a mean return of 475",
        "threshold",
        "each system's own tuned settings: Thorndike's preset, RL Baselines3 Zoo's for Stable-Baselines3 and SBX, rejax's configs/gymnax/"
        "cartpole.yaml; mean over at least the last 100 training episodes; a new seed each repetition",
        (
            thorndike_threshold(
                "Thorndike (cold cache)", "{fresh_cache}", False, "`thorndike train ppo CartPole-v1`, empty compilation cache"
            ),
            thorndike_threshold("Thorndike (warm cache)", "{warm_cache}", True, "the same, after one run that filled the cache"),
            peer("rejax", "rejax_ppo_threshold.py"),
            peer(
                "rejax (JAX's cache on)",
                "rejax_ppo_threshold.py",
                note="not its default: `JAX_COMPILATION_CACHE_DIR` set, after one run that filled the cache",
                JAX_COMPILATION_CACHE_DIR="{warm_cache}/rejax",
                JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS="0",
            ),
            peer("SBX", "sbx_ppo_threshold.py"),
            peer("Stable-Baselines3", "sb3_ppo_threshold.py"),
        ),
        (
            Claim("Thorndike (cold cache)", measure="cpu_s", at_most=12.0),
            Claim("Thorndike (warm cache)", measure="cpu_s", at_most=6.0),
        ),
    ),
    Task(
        "startup",
        "Start-up",
        "startup",
        "a whole process, from its start to its end",
        (
            command("`thorndike --help`", "{python}", ".venv/bin/thorndike", "--help"),
            command("`import thorndike`", "{python}", "-c", "import thorndike"),
            command("`import jax` (Thorndike's)", "{python}", "-c", "import jax"),
            command("`import rejax`", "{peers}", "-c", "import rejax"),
            command("`import sbx`", "{peers}", "-c", "import sbx"),
            command("`import stable_baselines3`", "{peers}", "-c", "import stable_baselines3"),
        ),
        (Claim("`thorndike --help`", measure="wall_s", at_most=0.3),),
    ),
)
