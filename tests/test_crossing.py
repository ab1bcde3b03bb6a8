"""What a crossing is: what it costs to wait and to go, what is seen, who overlaps, and its picture."""

import numpy as np
import pytest
from conftest import trial
from hypothesis import given, settings
from hypothesis import strategies as st

from lifelong_lib.environments.crossing import (
    COLUMN,
    COLUMNS,
    GO,
    LENGTH,
    PIXELS,
    ROW,
    ROWS,
    ROWS_BEHIND,
    SPEED,
    WIDTH,
    Crossing,
    grid,
    outcome_shares,
    overlaps,
)
from lifelong_lib.environments.pictures import OTHER, OWN, ROAD


class Toy(Crossing):
    """Going takes ``duration`` steps and ends as told; one car stands 20 m ahead of the own one, and a lane there."""

    def __init__(self, duration=3, outcome="success", discount=0.9, render_mode=None):
        super().__init__(discount, render_mode)
        self.duration, self.outcome, self.begun = duration, outcome, []

    def cars(self):
        return np.array([[50, 30 - LENGTH / 2, np.pi / 2, 0]]), np.array([[50, 50, 0, SPEED]])

    def _begin(self, seeded):
        self.begun.append(seeded)
        self.origin = np.array([50, 30 - ROWS_BEHIND * ROW])

    def _act(self, action):
        self.steps = min(100, self.steps + (self.duration if action == GO else [1, 2, 4, 8][action]))
        return self.outcome if action == GO else ""

    def _ground(self):
        return [np.array([[-200.0, 50], [200, 50]])], 4.0


# ------------------------------------------------------------------------------------------------------------- trials

@pytest.mark.parametrize(("outcome", "last"), [("success", 0.99), ("collision", -1.01)])
def test_a_trial_pays_for_each_step_and_for_its_end(outcome, last):
    env = Toy(outcome=outcome)
    begun, waited, went = trial(env, 5, [1, GO])
    assert begun[1] == {"steps": 0, "outcome": ""} and env.begun == [True]
    assert waited[1:] == (pytest.approx(-0.01 * 1.9), False, False, {"steps": 2, "outcome": ""})
    assert went[1:] == (pytest.approx(-0.01 * 1.9 + 0.81 * last), True, False, {"steps": 3, "outcome": outcome})
    trial(env, None, [GO])
    assert env.begun == [True, False]


def test_time_is_up_after_100_steps_also_while_going():
    waited = trial(Toy(), 0, [3] * 20)
    assert [step[4]["steps"] for step in waited[1:]] == [8] * 12 + [4]
    for end in (waited[-1], trial(Toy(duration=200, outcome=""), 0, [3, GO])[-1]):
        assert end[2:4] == (False, True) and end[4]["outcome"] == "timeout"


def test_a_trial_that_has_ended_is_not_stepped():
    env = Toy()
    with pytest.raises(RuntimeError, match="the trial has ended, or was never begun: reset the environment first"):
        env.step(0)
    for actions in ([GO], [3] * 13):
        trial(env, 0, actions)
        with pytest.raises(RuntimeError, match="the trial has ended"):
            env.step(0)


# ------------------------------------------------------------------------------------------------------------ pictures

def test_the_picture_covers_the_field_of_the_grid():
    env = Toy(render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (round(ROWS * ROW * PIXELS), round(COLUMNS * COLUMN * PIXELS), 3)
    assert picture.dtype == np.uint8

    def seen(x, y):  # [m] from the middle of the own car's line
        return tuple(picture[-1 - int((y + ROWS_BEHIND * ROW) * PIXELS), int((x + 100) * PIXELS)])

    assert seen(0, -0.4) == seen(0, -LENGTH + 0.4) == seen(0.6, -2) == OWN
    assert seen(0, 20) == seen(2.2, 20.6) == seen(-2.2, 19.4) == OTHER
    assert seen(3, 20) == seen(-99, 20) == seen(99, 21.5) == ROAD
    assert seen(0, 0.5) == seen(0, -LENGTH - 0.5) == seen(1.3, -2) == seen(30, 10) == (255, 255, 255)


def test_without_a_mode_there_is_no_picture_and_an_unknown_mode_is_one_clear_line():
    env = Toy()
    env.reset(seed=0)
    assert env.render() is None
    with pytest.raises(ValueError, match="^no render mode 'human'; there are None and 'rgb_array'$"):
        Toy(render_mode="human")


# --------------------------------------------------------------------------------------------------------- collisions

def box(car, n=41):
    """Points (n * n, 2) all over a car, its edges included."""
    along, across = np.meshgrid(np.linspace(-LENGTH / 2, LENGTH / 2, n), np.linspace(-WIDTH / 2, WIDTH / 2, n))
    c, s = np.cos(car[2]), np.sin(car[2])
    return car[:2] + np.stack([along * c - across * s, along * s + across * c], axis=-1).reshape(-1, 2)


def inside(points, car, margin=0.0):
    c, s = np.cos(car[2]), np.sin(car[2])
    offset = points - car[:2]
    ahead, aside = offset @ [c, s], offset @ [-s, c]
    return ((np.abs(ahead) <= LENGTH / 2 + margin) & (np.abs(aside) <= WIDTH / 2 + margin)).any()


def test_no_collision_is_missed_and_none_made_up_in_ten_thousand_trials():
    """The oracle tries 1,681 points of each car; within its grid of 12 cm it cannot be sure."""
    rng = np.random.default_rng(0)
    cars = np.column_stack([rng.uniform(-7, 7, (10_000, 2)), rng.uniform(-4, 4, (10_000, 1)), np.zeros(10_000)])
    one = np.array([0.0, 0, 0.7, 0])
    found, points = overlaps(one, cars), box(one)
    for car, hit in zip(cars, found, strict=True):
        theirs = box(car)
        if inside(points, car) or inside(theirs, one):
            assert hit, car
        elif hit:
            assert inside(points, car, 0.13) or inside(theirs, one, 0.13), car
    assert 0.2 < found.mean() < 0.6


angle, metres = st.floats(-4, 4), st.floats(-8, 8)


@given(x=metres, y=metres, turn=angle, own=angle, shift=metres, spin=angle)
@settings(max_examples=200, deadline=None)
def test_overlap_does_not_depend_on_who_is_asked_nor_on_the_frame(x, y, turn, own, shift, spin):
    a, b = np.array([0.0, 0, own, 0]), np.array([x, y, turn, 0])
    hit = overlaps(a, b[None])[0]
    grown = [overlaps(a, np.array([[x * f, y * f, turn, 0]]))[0] for f in (0.999, 1.001)]
    if grown[0] == grown[1]:  # not within rounding of touching
        assert overlaps(b, a[None])[0] == hit
        c, s = np.cos(spin), np.sin(spin)
        moved = [np.array([c * p[0] - s * p[1] + shift, s * p[0] + c * p[1], p[2] + spin, 0]) for p in (a, b)]
        assert overlaps(moved[0], moved[1][None])[0] == hit


# -------------------------------------------------------------------------------------------------------- observations

def test_a_car_stands_in_its_cell_with_heading_speed_and_presence():
    origin = np.array([100.0, 50.0])
    cars = np.array([
        [100 + 0.5 * COLUMN, 50 + 2.5 * ROW, 0.0, SPEED],  # to the right, at the limit
        [100 - 12.5 * COLUMN, 50 + 17.5 * ROW, np.pi, SPEED / 2],  # to the left
        [100 + 13.1 * COLUMN, 50 + 2.5 * ROW, 0.0, SPEED],  # too far to the right
        [100, 50 - 0.1, 0.0, SPEED],  # behind
    ])  # fmt: skip
    seen = grid(cars, origin)
    assert seen.shape == (ROWS, COLUMNS, 3) and seen.dtype == np.float32
    assert seen[2, 13].tolist() == [1, 1, 1] and seen[17, 0].tolist() == [0, 0.5, 1]
    assert np.count_nonzero(seen[:, :, 2]) == 2
    assert not grid(np.zeros((0, 4)), origin).any()


def test_shares_of_outcomes_by_hand():
    infos = [{"outcome": outcome} for outcome in ("success", "timeout", "success", "collision")]
    assert outcome_shares(infos).tolist() == [0.5, 0.25, 0.25]
