"""Trials as arrays: what is noted is what happened, and boxes are where the cars were."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lifelong_lib.environments.crossing import GO, STEP_SECONDS
from lifelong_lib.environments.intersections import Intersection
from lifelong_lib.environments.scenes import OUTSIDE, car_boxes, film, on_the_ground
from lifelong_lib.learners.q_learning import run_trial


@pytest.fixture
def env():
    made = Intersection("left")
    yield made
    made.close()


def play(env, seed, actions):
    """A trial with these actions one after another, whatever is seen."""
    left = iter(actions)
    return run_trial(env, lambda image, allowed: next(left), 1.0, seed)


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_filming_changes_nothing_and_notes_every_step(env, seed):
    actions = [2, 0, 3, GO]
    plain = play(env, seed, actions)
    env.sumo.noted = []
    trial = play(env, seed, actions)
    own, others, images = film(env.sumo.noted, env.origin)
    assert trial.images.tobytes() == plain.images.tobytes() and trial.info == plain.info
    ends = np.cumsum([0, *trial.steps])
    assert len(own) == len(others) == len(images) == ends[-1] + 1
    assert np.array_equal(images[ends], trial.images)


def test_the_next_trial_is_a_film_of_its_own(env):
    env.sumo.noted = []
    lengths = [play(env, seed, [3, GO]).steps.sum() + 1 == len(env.sumo.noted) for seed in (0, None, 1)]
    assert lengths == [True] * 3


def test_the_car_is_where_its_speed_takes_it():
    env = Intersection("forward")
    env.sumo.noted = []
    play(env, 0, [3, GO])
    own = film(env.sumo.noted, env.origin)[0]
    env.close()
    assert (own[:9] == own[0]).all() and own[0, 3] == 0
    moved = np.hypot(*np.diff(own[:, :2], axis=0).T)
    np.testing.assert_allclose(moved, own[1:, 3] * STEP_SECONDS, atol=1e-6)
    np.testing.assert_allclose(np.diff(own[8:, 3]), 2.6 * STEP_SECONDS, atol=1e-6)  # its acceleration, from standstill


def test_every_car_of_a_step_is_there_the_rest_is_outside_and_the_last_pose_is_held():
    a, b, c = ([number] * 4 for number in (1.0, 2.0, 3.0))
    frames = [(np.array([a]), np.array([b, c])), (np.zeros((0, 4)), np.array([c]))]
    own, others, images = film(frames, np.zeros(2))
    assert own.tolist() == [a, a]
    assert others.tolist() == [[b, c], [c, [*OUTSIDE]]]
    assert images.shape == (2, 18, 26, 3) and images[0, ..., 2].sum() == 1  # b and c lie in one cell


def test_boxes_stand_on_the_ground_and_are_turned_by_the_heading():
    cars = np.array([[[1.0, 2, 0.7, 5]], [[3, 4, -2, 5]]])
    centres, half, turns = car_boxes(cars)
    assert centres.tolist() == [[[1, 2, 0.75]], [[3, 4, 0.75]]] and half.tolist() == [2.5, 0.9, 0.75]
    ahead = Rotation.from_quat(turns[:, 0]).apply([1, 0, 0])
    np.testing.assert_allclose(ahead, [[np.cos(a), np.sin(a), 0] for a in (0.7, -2)], atol=1e-12)
    assert car_boxes(cars[:, 0])[0].shape == (2, 3) and car_boxes(cars[:, 0])[2].shape == (2, 4)
    assert on_the_ground([np.ones((2, 2))])["line 0"].tolist() == [[1, 1, 0], [1, 1, 0]]
