"""A cart that is in order, and many that are not: each has one mistake, and `kind` is what the checker calls it."""

import random

import gymnasium
import numpy as np
from gymnasium import spaces


class Cart(gymnasium.Env):
    """Keep a cart near the middle of a rail; nothing is wrong here. Observation: place, speed. Over the edge is the end."""

    observation_space = spaces.Box(-2, 2, (2,), np.float32)
    action_space = spaces.Discrete(3)
    limit = 60

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.speed, self.steps = self.np_random.uniform(-0.5, 0.5), self.np_random.uniform(-0.05, 0.05), 0
        return self.look(), {}

    def step(self, action):
        self.steps += 1
        self.speed += 0.05 * (int(action) - 1)
        self.place = float(np.clip(self.place + self.speed, -1.2, 1.2))
        return self.look(), self.reward(), self.fallen(), self.steps >= self.limit, {}

    def look(self):
        return np.array([self.place, np.clip(self.speed, -2, 2)], np.float32)

    def reward(self):
        return 1.0 - abs(self.place)

    def fallen(self):
        return abs(self.place) > 1


class NoSpace(Cart):
    kind = "space_missing"
    action_space = None


class TextObservation(Cart):
    kind = "unsupported_space"
    observation_space = spaces.Text(5)

    def look(self):
        return "left"


class OldReset(Cart):
    kind = "reset_signature"

    def reset(self):
        return super().reset()


class ObservationAlone(Cart):
    kind = "reset_return"

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed)[0]


class FourValues(Cart):
    kind = "step_return"

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated or truncated, info


class ThreeArguments(Cart):
    kind = "step_signature"

    def step(self, action, force):
        return super().step(action)


class Crash(Cart):
    kind = "exception"

    def step(self, action):
        if self.steps == 7:
            return [][action]  # the line that breaks
        return super().step(action)


class WrongKeys(Cart):
    kind = "observation_structure"
    observation_space = spaces.Dict({"cart": Cart.observation_space, "goal": spaces.Discrete(2)})

    def look(self):
        return {"cart": super().look()}


class WrongShape(Cart):
    kind = "observation_shape"

    def look(self):
        return super().look()[:1]


class NoArray(Cart):
    kind = "observation_type"

    def look(self):
        return None


class FloatForWhole(Cart):
    kind = "observation_dtype"
    observation_space = spaces.Dict({"cart": Cart.observation_space, "cell": spaces.Discrete(10)})

    def look(self):
        return {"cart": super().look(), "cell": 5 + 2 * self.place}


class OutOfBounds(Cart):
    kind = "observation_bounds"
    observation_space = spaces.Tuple([spaces.Box(-0.6, 0.6, (2,), np.float32)])

    def look(self):
        return (super().look(),)


class NotANumber(Cart):
    kind = "observation_not_finite"
    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def look(self):
        return np.array([self.place, np.nan if self.place > 0.9 else self.speed], np.float32)


class ReusedArray(Cart):
    kind = "observation_reused"
    array = None

    def look(self):
        if self.array is None:
            self.array = np.zeros(2, np.float32)
        self.array[:] = super().look()
        return self.array


class RewardArray(Cart):
    kind = "reward_type"

    def reward(self):
        return np.array([super().reward()])


class InfiniteReward(Cart):
    kind = "reward_not_finite"

    def reward(self):
        return np.inf if self.place > 0.9 else super().reward()


class HugeReward(Cart):
    kind = "reward_scale"

    def reward(self):
        return 1e5 * super().reward()


class TinyReward(HugeReward):
    def reward(self):
        return 1e-4 * Cart.reward(self)


class SameReward(Cart):
    kind = "reward_constant"

    def reward(self):
        return 0.5

    def fallen(self):
        return False


class NumberForEnd(Cart):
    kind = "end_type"

    def fallen(self):
        return int(super().fallen())


class ListForInfo(Cart):
    kind = "info_type"

    def step(self, action):
        return (*super().step(action)[:4], [])


class UnseededStart(Cart):
    kind = "seeding"

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = random.uniform(-0.5, 0.5)
        return self.look(), {}


class UnseededWind(Cart):
    kind = "determinism"

    def step(self, action):
        self.place += np.random.normal() / 100
        return super().step(action)


class RandomTrack(Cart):
    """What is drawn when it is made differs from one to the next."""

    kind = "determinism"

    def __init__(self):
        self.friction = random.uniform(0.9, 1)

    def step(self, action):
        self.speed *= self.friction
        return super().step(action)


class Leftovers(Cart):
    """The speed of the last episode goes on."""

    kind = "reset_incomplete"

    def reset(self, *, seed=None, options=None):
        speed = getattr(self, "speed", 0.0)
        super().reset(seed=seed)
        self.speed += 0.1 * speed
        return self.look(), {}


class GlobalGenerator(Cart):
    """Repeatable alone, but two of them draw from one stream."""

    kind = "shared_state"

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            np.random.seed(seed)
        super().reset(seed=seed)
        return self.look(), {}

    def step(self, action):
        self.place += np.random.normal() / 100
        return super().step(action)


class SameAgain(Cart):
    """Without a seed every episode is the same."""

    kind = "reset_repeats"

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed or 0)


class NeverVaries(Cart):
    kind = "seed_has_no_effect"

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=5)


class Endless(Cart):
    kind = "never_ends"
    limit = np.inf

    def fallen(self):
        return False


class EndlessIfStill(Cart):
    """Random actions drive it over the edge; one that stands still stays."""

    kind = "no_time_limit"
    limit = np.inf

    def step(self, action):
        self.speed = 0.15 * (int(action) - 1)
        return super().step(action)


class LimitAsTermination(Cart):
    kind = "time_limit_as_termination"
    limit = 20

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated or truncated, False, info


class Merged(Cart):
    kind = "ends_merged"

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated or truncated, terminated or truncated, info


class Swapped(Cart):
    kind = "ends_swapped"

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, truncated, terminated, info


class TooFar(Cart):
    kind = "step_after_end"

    def step(self, action):
        if self.fallen() or self.steps >= self.limit:
            raise KeyError("place")
        return super().step(action)


class SameActions(Cart):
    """Actions 1 and 2 do the same."""

    kind = "idle_actions"

    def step(self, action):
        return super().step(min(int(action), 1))


class IdleDimension(Cart):
    kind = "idle_actions"
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def step(self, action):
        return super().step(1 + action[0])


class NoSpeed(Cart):
    """The speed is hidden."""

    kind = "hidden_state"
    observation_space = spaces.Box(-2, 2, (1,), np.float32)

    def look(self):
        return super().look()[:1]


class HiddenGoal(Cart):
    """A cell of five; where the goal is cannot be seen."""

    kind = "hidden_state"
    observation_space = spaces.Discrete(5)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.goal, self.cell = int(self.np_random.integers(5)), 2
        return self.cell, {}

    def step(self, action):
        super().step(1)
        self.cell = int(np.clip(self.cell + int(action) - 1, 0, 4))
        return self.cell, float(self.cell == self.goal), False, self.steps >= 20, {}


class DeadNumber(Cart):
    kind = "observation_constant"
    observation_space = spaces.Box(-2, 2, (3,), np.float32)

    def look(self):
        return np.append(super().look(), np.float32(1))


class Millimetres(Cart):
    kind = "observation_scale"
    observation_space = spaces.Box(-2000, 2000, (2,), np.float32)

    def look(self):
        return super().look() * 1000


class EndlessBounds(Cart):
    kind = "action_bounds_endless"
    action_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)

    def step(self, action):
        return super().step(np.clip(action[0], -1, 1) + 1)


class LopsidedBounds(EndlessBounds):
    kind = "action_bounds_lopsided"
    action_space = spaces.Box(-1, 1000, (1,), np.float32)


class EmptyBounds(EndlessBounds):
    kind = "action_bounds_empty"
    action_space = spaces.Box(np.array([-1, 0], np.float32), np.array([1, 0], np.float32))


class WholeBox(EndlessBounds):
    kind = "action_dtype"
    action_space = spaces.Box(-1, 1, (1,), np.int64)


class OneAction(Cart):
    kind = "single_action"
    action_space = spaces.Discrete(1)


class WritesToAction(EndlessBounds):
    kind = "action_changed"
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def step(self, action):
        action *= 0.5
        return super().step(action)


class Masked(Cart):
    """In order: at the edges one may only push back."""

    def info(self):
        return {"action_mask": np.array([self.place > -0.8, True, self.place < 0.8], np.int8)}

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed)[0], self.info()

    def step(self, action):
        assert self.info()["action_mask"][action]
        return (*super().step(action)[:4], self.info())


class ShortMask(Masked):
    kind = "action_mask"

    def info(self):
        return {"action_mask": np.ones(2, np.int8)}

    def step(self, action):
        return (*Cart.step(self, action)[:4], self.info())


class EmptyMask(Masked):
    kind = "action_mask"

    def info(self):
        return {"action_mask": np.zeros(3, bool)}

    def step(self, action):
        return (*Cart.step(self, action)[:4], self.info())


class ForgottenMask(Masked):
    kind = "action_mask"

    def step(self, action):
        return Cart.step(self, action)


class MaskOfNumbers(ShortMask):
    def info(self):
        return {"action_mask": np.array([0.5, 1, 1])}


class TwoMasks(Masked):
    kind = "action_mask"

    def action_masks(self):
        return np.ones(3, bool)


class BrokenClose(Cart):
    kind = "close"

    def close(self):
        raise AttributeError("no window")
