"""Trials as arrays: what is noted is what happened, and boxes are where the cars were."""

import numpy as np
import pytest
from conftest import trial
from scipy.spatial.transform import Rotation

from lifelong_lib.environments.crossing import GO, STEP_SECONDS
from lifelong_lib.environments.intersections import Intersection
from lifelong_lib.environments.scenes import OUTSIDE, car_boxes, on_the_ground, watch


@pytest.fixture
def env():
    made = Intersection("left")
    yield made
    made.close()


def following(actions):
    """A policy that takes these actions one after another, whatever it sees."""
    left = iter(actions)
    return lambda image: next(left)


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_watching_changes_nothing_and_notes_every_step(env, seed):
    actions = [2, 0, 3, GO]
    plain = trial(env, seed, actions)
    watched = watch(env, following(actions), seed)
    ends = np.cumsum([0, *(step[4]["steps"] for step in plain[1:])])
    assert watched.decisions == list(zip(ends[:-1].tolist(), actions, strict=True))
    assert watched.outcome == plain[-1][4]["outcome"]
    assert len(watched.own) == len(watched.others) == len(watched.images) == ends[-1] + 1
    for image, step in zip(watched.images[ends], plain, strict=True):
        assert np.array_equal(image, step[0])
    assert env.sumo.noted is None


def test_the_car_is_where_its_speed_takes_it():
    env = Intersection("forward")
    own = watch(env, following([3, GO]), 0).own
    env.close()
    assert (own[:9] == own[0]).all() and own[0, 3] == 0
    moved = np.hypot(*np.diff(own[:, :2], axis=0).T)
    np.testing.assert_allclose(moved, own[1:, 3] * STEP_SECONDS, atol=1e-6)
    np.testing.assert_allclose(np.diff(own[8:, 3]), 2.6 * STEP_SECONDS, atol=1e-6)  # its acceleration, from standstill


def test_every_car_of_a_step_is_there_and_the_rest_is_outside(env):
    watched = watch(env, following([0] * 3 + [GO]), 1)
    env.reset(seed=1)
    for place in range(4):
        cars = env.cars()[1]
        assert np.array_equal(watched.others[place, : len(cars)], cars)
        assert (watched.others[place, len(cars) :] == OUTSIDE).all()
        env.step(0)
    assert (watched.others[:, :, 0] != 0).all(axis=1).any(), "no more places than the fullest step needs"


def test_the_last_pose_is_held_once_the_car_has_left():
    class Leaving:
        """A step in which the own car moves, and two without it; another car is there in these."""

        sumo, origin, place = type("Sumo", (), {"noted": None})(), np.zeros(2), 0

        def cars(self):
            own = [[1.0, 2, 3, 4], [5, 6, 7, 8]][self.place :][:1]
            return np.reshape(own, (-1, 4)), np.reshape([[9.0, 9, 0, 1]] * (self.place > 1), (-1, 4))

        def reset(self, seed):
            return None, {}

        def step(self, action):
            for self.place in (1, 2, 3):
                self.sumo.noted.append(self.cars())
            return None, 0.0, True, False, {"outcome": "success"}

    watched = watch(Leaving(), lambda image: GO, 0)
    assert watched.own.tolist() == [[1, 2, 3, 4], [5, 6, 7, 8], [5, 6, 7, 8], [5, 6, 7, 8]]
    assert watched.others[:, 0].tolist() == [[*OUTSIDE]] * 2 + [[9, 9, 0, 1]] * 2


def test_boxes_stand_on_the_ground_and_are_turned_by_the_heading():
    cars = np.array([[[1.0, 2, 0.7, 5]], [[3, 4, -2, 5]]])
    centres, half, turns = car_boxes(cars)
    assert centres.tolist() == [[[1, 2, 0.75]], [[3, 4, 0.75]]] and half.tolist() == [2.5, 0.9, 0.75]
    ahead = Rotation.from_quat(turns[:, 0]).apply([1, 0, 0])
    np.testing.assert_allclose(ahead, [[np.cos(a), np.sin(a), 0] for a in (0.7, -2)], atol=1e-12)
    assert car_boxes(cars[:, 0])[0].shape == (2, 3) and car_boxes(cars[:, 0])[2].shape == (2, 4)
    assert on_the_ground([np.ones((2, 2))])["line 0"].tolist() == [[1, 1, 0], [1, 1, 0]]
