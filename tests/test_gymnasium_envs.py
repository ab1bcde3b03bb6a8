"""The Gymnasium environments pass Gymnasium's own checker and take exactly the steps of `Tasks.roll_out`."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from lifelong_lib.environments.dynamical_systems import SYSTEMS, Tasks, draw_tasks
from lifelong_lib.environments.gymnasium_envs import IDS, DynamicalSystem
from lifelong_lib.environments.pictures import OTHER, PALE

every_system = pytest.mark.parametrize("name", list(SYSTEMS))
OWN_PARAMETERS = {"spring-mass-damper": [1, 0.1, 3], "cart-pole": [0.5, 0.2, 0.5, 0.1],
                  "bicycle": [12, 0.4, 0.5, 1.5, 0.08, 1.2], "quadrotor": [5e-3, 4e-3, 2e-2, 0.25]}


def test_the_names_are_those_that_were_promised():
    assert [*IDS.values()] == [f"lifelong_lib/{name}-v0" for name in
                               ("SpringMassDamper", "CartPole", "Bicycle", "Quadrotor")]
    assert [*IDS] == [*SYSTEMS]


@every_system
@pytest.mark.parametrize("given", [False, True])
def test_gymnasiums_checker_is_content(name, given):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        check_env(gym.make(IDS[name], parameters=OWN_PARAMETERS[name] if given else None).unwrapped)
    about_limits = ("infinity", "symmetric and normalized")  # the systems have no limits, and units instead of scales
    assert [str(w.message) for w in said if not any(words in str(w.message) for words in about_limits)] == []


@every_system
def test_the_picture_shows_the_state_and_where_it_should_be(name):
    env = gym.make(IDS[name], parameters=OWN_PARAMETERS[name], render_mode="rgb_array")
    env.reset(seed=0)
    at_rest, moved = np.zeros(len(SYSTEMS[name].state)), np.full(len(SYSTEMS[name].state), 0.5)
    pictures = []
    for state in (at_rest, moved):
        env.unwrapped.state = state
        pictures.append(env.render())
    blue = [np.argwhere((picture == OTHER).all(axis=2)) for picture in pictures]
    grey = [(picture == PALE).all(axis=2).sum() for picture in pictures]
    assert len(blue[0]) > 300 and 0.3 < len(blue[1]) / len(blue[0]) < 3
    assert grey[1] > grey[0] + 200, "at rest the body hides its goal"
    assert env.metadata["render_fps"] == round(1 / SYSTEMS[name].step_seconds)
    if name == "spring-mass-damper":  # 0.5 m to the right, at 200 pixels a metre; the spring grows with it
        assert blue[1][:, 1].max() - blue[0][:, 1].max() == 100
    if name == "cart-pole":  # the cart to the right; its pole, of 1 m, leans to the left by 0.5 rad
        tip = blue[1][blue[1][:, 0].argmin()]
        assert tip[1] - 477 == pytest.approx(90 * (0.5 - np.sin(0.5)), abs=4)
    if name == "bicycle":  # tilts to its right
        assert blue[1][:, 1].mean() > blue[0][:, 1].mean() + 5


def test_without_a_mode_there_is_no_picture_and_an_unknown_mode_is_one_clear_line():
    env = gym.make(IDS["cart-pole"])
    env.reset(seed=0)
    assert env.unwrapped.render() is None
    with pytest.raises(ValueError, match="^no render mode 'ansi'; there are None and 'rgb_array'$"):
        DynamicalSystem("cart-pole", render_mode="ansi")


@every_system
def test_every_step_is_that_of_roll_out_bit_for_bit(name):
    system, parameters = SYSTEMS[name], np.array([OWN_PARAMETERS[name]])
    tasks = Tasks(system, parameters, np.ones((1, len(system.state))))
    policy = np.full((1, system.policy_size), -0.3)
    expected = tasks.roll_out(policy, 1, [np.random.default_rng(5)], noise=0.5)
    env = gym.make(IDS[name], parameters=parameters[0])
    env.reset(seed=0)
    env.unwrapped.state = expected.states[0, 0, 0].copy()
    for step in range(100):
        state, reward, terminated, truncated, _ = env.step(expected.actions[0, 0, step])
        assert state.tobytes() == expected.states[0, 0, step + 1].tobytes(), f"step {step}"
        assert reward == expected.rewards[0, 0, step] and not terminated and truncated == (step == 99)


@every_system
def test_a_seed_draws_task_and_start_as_tasks_does(name):
    env, rng = gym.make(IDS[name]), np.random.default_rng(8)
    state, info = env.reset(seed=8)
    tasks = draw_tasks(SYSTEMS[name], 1, rng)
    first = tasks.roll_out(np.zeros((1, SYSTEMS[name].policy_size)), 1, [rng], noise=0.0, steps=1).states[0, 0, 0]
    assert np.array_equal(state, first)
    assert [*info["parameters"].values()] == tasks.parameters[0].tolist()
    again, other = env.reset(seed=8)[0], env.reset()
    assert np.array_equal(again, state) and not np.array_equal(other[0], state)
    assert other[1]["parameters"] != info["parameters"], "a new task at every reset"


@every_system
def test_info_names_the_parameters_with_their_units(name):
    env = gym.make(IDS[name], parameters=OWN_PARAMETERS[name])
    state, info = env.reset(seed=3)
    names = [f"{quantity.name} [{quantity.unit}]" for quantity in SYSTEMS[name].parameters]
    assert info["parameters"] == dict(zip(names, OWN_PARAMETERS[name], strict=True))
    assert np.array_equal(state, gym.make(IDS[name]).reset(seed=3)[0]), "the start is that of the seed"
    assert env.step(np.zeros(len(SYSTEMS[name].actions)))[4]["parameters"] == info["parameters"]


def test_what_is_handed_out_cannot_change_the_world():
    env = gym.make(IDS["cart-pole"], parameters=OWN_PARAMETERS["cart-pole"])
    state, _ = env.reset(seed=0)
    expected = env.unwrapped.state.copy()
    state[:] = 7
    assert np.array_equal(env.unwrapped.state, expected)
    env.step(np.zeros(1))[0][:] = 7
    assert not (env.unwrapped.state == 7).any()


@pytest.mark.parametrize(("parameters", "said"), [
    ([1, 2, 3], r"cart mass \[kg\], pole mass \[kg\], pole length \[m\], damping \[N s/m\]"),
    ([1, 2, -3, 4], "cart-pole: pole length .* must be positive"),
    ([1, 2, 3, np.nan], "cart-pole: damping .* must be positive"),
])
def test_parameters_that_cannot_be_are_refused(parameters, said):
    with pytest.raises(ValueError, match=said):
        gym.make(IDS["cart-pole"], parameters=parameters)


@pytest.mark.parametrize("action", [[np.nan], [1.0, 2.0], [np.inf], 3.0])
def test_actions_that_cannot_be_are_refused(action):
    env = gym.make(IDS["cart-pole"]).unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"cart-pole: actions must be finite and \(1,\), got"):
        env.step(action)
