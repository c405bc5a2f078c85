"""Environments that do one thing wrong, at one step. In a module, so that worker processes find them."""

import os
import re
import signal
import subprocess
import sys
import time

import gymnasium
import numpy as np
from gymnasium import spaces

FOREVER = 1000


class FaultyEnv(gymnasium.Env):
    """Counts its steps, episodes of 8; what it does at step `at` (of the environment, not the episode) is method `fault`."""

    def __init__(self, fault: str = "nothing", at: int = 3) -> None:
        if fault.startswith("construction_"):
            getattr(self, fault)()
        self.fault, self.at, self.total, self.count = fault, at, 0, 0
        box = spaces.Box(-10, 10, (2,), np.float32)
        self.observation_space = spaces.Dict({"place": box, "picture": spaces.Box(0, 255, (2, 2, 1), np.uint8), "room": spaces.Discrete(9)})
        self.action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        self.count = 0
        if self.fault.startswith("reset_") and self.total >= self.at:
            return getattr(self, self.fault)()
        return self.observe(), {}

    def step(self, action):
        self.count, self.total = self.count + 1, self.total + 1
        if self.total == self.at and not self.fault.startswith("reset_"):
            return getattr(self, self.fault)()
        return self.outcome()

    def observe(self, **changed):
        picture = np.full((2, 2, 1), self.count, np.uint8)
        return {"place": np.array([self.count, 0], np.float32), "picture": picture, "room": self.count} | changed

    def outcome(self, reward=1.0, terminated=None, **changed):
        return self.observe(**changed), reward, self.count == 8 if terminated is None else terminated, False, {}

    # What can be wrong with what is returned.

    def nothing(self):
        return self.outcome()

    def shape(self):
        return self.outcome(place=np.zeros(3, np.float32))

    def dtype(self):
        return self.outcome(picture=np.zeros((2, 2, 1), np.float32))

    def wide_whole_numbers(self):
        return self.outcome(picture=np.zeros((2, 2, 1), np.int64))

    def text(self):
        return self.outcome(room="kitchen")

    def nan(self):
        return self.outcome(place=np.array([0, np.nan], np.float32))

    def infinity(self):
        return self.outcome(place=np.array([-np.inf, 0], np.float32))

    def out_of_box(self):
        return self.outcome(place=np.array([0, 10.5], np.float32))

    def out_of_discrete(self):
        return self.outcome(room=9)

    def missing_key(self):
        return {"place": np.zeros(2, np.float32)}, 1.0, False, False, {}

    def no_dict(self):
        return np.zeros(2, np.float32), 1.0, False, False, {}

    def nan_reward(self):
        return self.outcome(reward=float("nan"))

    def huge_reward(self):
        return self.outcome(reward=1e300)

    def row_of_rewards(self):
        return self.outcome(reward=np.ones(1))

    def no_reward(self):
        return self.outcome(reward=None)

    def odd_flag(self):
        return self.outcome(terminated="no")

    def four_values(self):
        return self.observe(), 1.0, False, {}

    def raises(self):
        raise ZeroDivisionError("by\nzero")

    # What can happen to a process.

    def exits(self):
        os._exit(3)

    def sys_exits(self):
        sys.exit("enough")

    def dies(self):
        os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(FOREVER)

    def crashes(self):
        os.kill(os.getpid(), signal.SIGSEGV)
        time.sleep(FOREVER)

    def sleeps(self):
        time.sleep(FOREVER)

    def stops(self):
        os.kill(os.getpid(), signal.SIGSTOP)

    def hangs_in_native_code(self):
        """Holds the interpreter's lock: no thread of this process runs again."""
        re.match(r"(a+)+$", "a" * 60 + "b")

    def hangs_and_defends_itself(self):
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
        subprocess.Popen([sys.executable, "-c", f"import time; time.sleep({FOREVER})"])
        time.sleep(FOREVER)

    def reset_sleeps(self):
        time.sleep(FOREVER)

    def reset_raises(self):
        raise KeyError("door")

    def reset_shape(self):
        return self.observe(place=np.zeros(1, np.float32)), {}

    def reset_nan(self):
        return self.observe(place=np.full(2, np.nan, np.float32)), {}

    def reset_only_observation(self):
        return self.observe()

    def construction_raises(self):
        raise FileNotFoundError("no level 3")

    def construction_sleeps(self):
        if "worker" in " ".join(sys.orig_argv):
            time.sleep(FOREVER)


class OtherSpaceEnv(FaultyEnv):
    """Has one action more."""

    def __init__(self) -> None:
        super().__init__()
        self.action_space = spaces.Discrete(3)


class StepsEnv(gymnasium.Env):
    """Observation: steps so far, one of 50. For tables; `fault` as above."""

    def __init__(self, fault: str = "nothing", at: int = 3) -> None:
        self.faulty = FaultyEnv(fault, at)
        self.observation_space, self.action_space = spaces.Discrete(50), spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        self.count = self.faulty.count = 0
        return 0, {}

    def step(self, action):
        self.faulty.step(action)
        self.count += 1
        return self.count, 1.0, self.count == 49, False, {}
