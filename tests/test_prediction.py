"""Prediction as a constraint: against hand arithmetic, sampled boxes and a brute-force simulation of its model."""

import numpy as np
import pytest

from lifelong_lib.environments.prediction import (
    FASTEST,
    LIMIT,
    PROFILES,
    STANDARD,
    VIEW,
    Margins,
    Prediction,
    corners,
    covered,
    poses_along,
    travelled,
)

MIDDLE = np.array([10.0, 20.0])
TURN = [[11.6, 12.8], [11.05, 16.65], [9.4, 19.4], [6.65, 21.05], [2.8, 21.6], [-6.2, 21.6]]  # [m] a left turn
INSIDE = np.linalg.norm(np.diff(TURN, axis=0), axis=1)[:-1].sum()
EMPTY = np.zeros((0, 4))


def prediction(**more):
    given = {"path": np.array(TURN), "line": 0.1, "across": INSIDE + 5, "middle": MIDDLE, "margins": STANDARD}
    return Prediction(**given | more)


def car(x, lane, speed):
    """A car on the southern (0) or the northern lane (1), x metres from the middle."""
    return [MIDDLE[0] + x, MIDDLE[1] + (-1.6, 1.6)[lane], (0.0, np.pi)[lane], speed]


# ------------------------------------------------------------------------------------------------------------ geometry

def test_a_car_speeds_up_as_in_sumo_whose_steps_use_the_new_speed():
    assert travelled(0.5, 3) == pytest.approx([0, 0.02, 0.06, 0.12])
    assert np.diff(travelled(10.0, 20))[-1] == pytest.approx(LIMIT * 0.2)


def test_a_car_comes_from_the_south_and_leaves_to_the_west():
    first, last = poses_along(np.array(TURN), np.array([-0.1, INSIDE + 5]))
    assert first == pytest.approx([11.6, 12.8 - 0.1 - 2.5, np.pi / 2])
    assert last == pytest.approx([2.8 - 2.5, 21.6, np.pi])


def test_what_a_box_covers_of_a_strip_is_what_its_points_do():
    rng = np.random.default_rng(0)
    poses = np.column_stack([rng.uniform(-3, 3, (200, 2)), rng.uniform(-np.pi, np.pi, 200)])
    size, shares = (7.0, 2.8), np.linspace(-0.5, 0.5, 401)
    found = covered(corners(poses, size), -1.4, 1.4)
    for (x, y, heading), (low, high) in zip(poses, found, strict=True):
        along, aside = np.meshgrid(shares * size[0], shares * size[1])
        inside = np.abs(y + np.sin(heading) * along + np.cos(heading) * aside) <= 1.4
        if inside.any():
            xs = (x + np.cos(heading) * along - np.sin(heading) * aside)[inside]
            assert low == pytest.approx(xs.min(), abs=0.05) and high == pytest.approx(xs.max(), abs=0.05)
        else:
            assert low == np.inf and high == -np.inf or high - low < 0.1


# ------------------------------------------------------------------------------------------------------- brute force

def own_poses(acceleration):
    """The own car step by step, walking along its path, until it is across."""
    points = [np.array([11.6, 0.0]), *map(np.array, TURN)]

    def point(distance):
        for start, end in zip(points[:-1], points[1:], strict=True):
            length = np.linalg.norm(end - start)
            if distance <= length or end is points[-1]:
                return start + distance / length * (end - start)
            distance -= length

    speed, place, poses = 0.0, 12.8 - 0.1, []
    while not poses or place - 12.8 < INSIDE + 5:
        if poses:
            speed = min(speed + 0.2 * acceleration, LIMIT)
            place += 0.2 * speed
        front, back = point(place), point(place - 5)
        heading = np.arctan2(*(front - back)[::-1])
        poses.append([*(front - 2.5 * np.array([np.cos(heading), np.sin(heading)])), heading])
    return poses


def boxes_meet(pose, size, places, sizes):
    """Whether a box meets boxes along the x axis: places (..., 2), sizes (..., 2). A plain test of four axes."""
    box = corners(np.array([pose]), size)[0]
    apart = np.zeros(places.shape[:-1], bool)
    for axis in (0, 1):
        apart |= box[:, axis].min() > places[..., axis] + sizes[..., axis] / 2
        apart |= box[:, axis].max() < places[..., axis] - sizes[..., axis] / 2
    for angle, half in ((pose[2], size[0] / 2), (pose[2] + np.pi / 2, size[1] / 2)):
        axis = np.array([np.cos(angle), np.sin(angle)])
        apart |= np.abs((places - pose[:2]) @ axis) > half + (sizes / 2) @ np.abs(axis)
    return ~apart


def brute_force(scenes, margins, unseen):
    """Which profiles are safe in scenes (n, cars, 4): all boxes at all steps."""
    if unseen:
        ends = np.array([car(-VIEW, 0, FASTEST), car(VIEW, 1, FASTEST)])
        scenes = np.concatenate([scenes, np.tile(ends, (len(scenes), 1, 1))], axis=1)
    seen = np.abs(scenes[..., 0] - MIDDLE[0]) <= VIEW
    extra = np.full(scenes.shape[1], margins.extra)
    extra[scenes.shape[1] - 2 * unseen :] = 0
    safe = np.ones((len(scenes), len(PROFILES)), bool)
    for number, acceleration in enumerate(PROFILES):
        for step, pose in enumerate(own_poses(acceleration)):
            places = scenes[..., :2].copy()
            places[..., 0] += scenes[..., 3] * np.cos(scenes[..., 2]) * 0.2 * step
            places[..., 1] = np.where(places[..., 1] > MIDDLE[1], MIDDLE[1] + 1.6, MIDDLE[1] - 1.6)
            lengths = 5 + 2 * (margins.fixed + margins.growth * (0.2 * step) ** 2 + extra)
            sizes = np.stack([np.broadcast_to(lengths, seen.shape), np.full(seen.shape, 1.8 + 2 * margins.aside)], -1)
            own = 5 + 2 * margins.own, 1.8 + 2 * margins.aside
            safe[:, number] &= ~(boxes_meet(pose, own, places, sizes) & seen).any(axis=1)
    return safe


@pytest.mark.parametrize(("margins", "unseen", "count"), [
    (STANDARD, True, 10_000), (Margins(extra=4.0), True, 2000), (Margins(0.0, 0.0, 0.0, 0.0, 0.0), False, 2000)])
def test_masks_are_those_of_a_forward_simulation_of_all_boxes(margins, unseen, count):
    rng = np.random.default_rng(1)
    cars = 4
    draws = np.column_stack([rng.uniform(-130, 130, cars * count), rng.integers(2, size=cars * count),
                             rng.uniform(0, 18, cars * count)])  # fmt: skip
    scenes = np.array([car(x, int(lane), speed) for x, lane, speed in draws]).reshape(count, cars, 4)
    scenes[..., 1] += rng.uniform(-0.3, 0.3, scenes.shape[:2])  # what counts is the lane
    predict = prediction(margins=margins, unseen=unseen)
    ours, theirs = np.array([predict.safe(scene) for scene in scenes]), brute_force(scenes, margins, unseen)
    assert (ours == theirs).all()
    possible = theirs[:, 1:] if unseen else theirs
    assert 0.02 < possible.mean(axis=0).min() and possible.mean(axis=0).max() < 0.9  # both answers are there


def test_wider_margins_never_allow_more():
    rng = np.random.default_rng(2)
    widths = [prediction(margins=margins, unseen=False) for margins in (
        Margins(growth=0.0), STANDARD, Margins(extra=2.0), Margins(fixed=5.0, extra=2.0, own=3.0))]  # fmt: skip
    for _ in range(300):
        scene = [car(x, lane, 12.0) for x, lane in zip(rng.uniform(-100, 100, 3), (0, 1, 1), strict=True)]
        allowed = np.array([predict.safe(scene) for predict in widths]).astype(int)
        assert (np.diff(allowed, axis=0) <= 0).all()


# --------------------------------------------------------------------------------------------------- what is assumed

def test_on_a_free_road_the_slowest_profile_would_take_too_long_for_who_may_come_into_view():
    assert prediction(unseen=False).safe(EMPTY).tolist() == [True, True, True]
    assert prediction().safe(EMPTY).tolist() == [False, True, True]


def test_a_car_that_comes_is_waited_for_and_one_that_has_passed_is_not():
    predict = prediction()
    for lane, sign, away in ((0, -1, 40), (1, 1, 65)):
        assert not predict.safe([car(sign * away, lane, LIMIT)]).any()
        assert predict.safe([car(-sign * 40, lane, LIMIT)]).tolist() == [False, True, True]


def test_who_is_out_of_view_does_not_count_and_nothing_is_remembered():
    predict, scene = prediction(), [car(-60, 0, 10.0), car(-90, 0, 14.0)]
    before = predict.safe(scene)
    assert predict.safe([*scene, car(-101, 0, 40.0), car(-30, 1, LIMIT)]).tolist() == before.tolist()
    predict.safe([car(-10, 0, 10.0)])
    assert predict.safe(scene).tolist() == before.tolist()


def test_regions_move_with_the_car_and_grow_with_the_square_of_time():
    now, later = (prediction(margins=Margins(extra=1.0)).regions([car(-60, 0, 10.0)], step) for step in (0, 10))
    assert now[0] == pytest.approx([-50, 18.4, 5 + 2 * 3, 2.8])
    assert later[0] == pytest.approx([-30, 18.4, 5 + 2 * (3 + 4 * STANDARD.growth), 2.8])
    assert now[1:, 0].tolist() == [-90, 110] and now[1:, 2].tolist() == [9, 9]  # those that may come into view


# ---------------------------------------------------------------------------------------------------------- bad input

@pytest.mark.parametrize(("make", "words"), [
    (lambda: Margins(fixed=-1), "the margin 'fixed' must be 0 or more, not -1"),
    (lambda: Margins(growth=float("nan")), "the margin 'growth' must be 0 or more, not nan"),
    (lambda: prediction(horizon=0), "a horizon of 1 step or more, not 0"),
    (lambda: prediction(profiles=(0.0,)), "a car that speeds up by 0.0 m/s.2 is not across within 12 s"),
    (lambda: prediction(horizon=40), "a car that speeds up by 0.5 m/s.2 is not across within 8 s"),
    (lambda: prediction().safe([[0, 18.4, 0, np.nan]]), "a car of the scene has no place, heading or speed")])
def test_bad_input_is_answered_in_a_line(make, words):
    with pytest.raises(ValueError, match=words) as caught:
        make()
    assert "\n" not in str(caught.value)
