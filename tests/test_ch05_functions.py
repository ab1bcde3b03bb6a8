"""Chapter 5: functions that decide its claims and do not depend on how networks learn, on shares made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from notebook_functions import load, runs, same

NAMES = ["right", "left", "left2", "forward", "challenge"]
LINES = load(5, "LINES").LINES


# ------------------------------------------------------------------------------------------------------- the gap rule

def rule(*cars, margin=0.0, learned="both", shift=0.0):
    """What the rule does (0: wait, 4: go) for cars (x, y, speed) on roads of round numbers.

    Lanes are 4 m wide and begin one row beyond the line, so that the nearest ones have their middles 6 and 10 m ahead.
    Cars are 8 m long and 2 m wide; with 2 m/s^2 the own car needs sqrt(d) s for d m. It is in the nearest lane from
    sqrt(6 - 2) = 2 s on, when its front comes within a width of the lane's middle, to sqrt(6 + 8 + 2) = 4 s.
    """
    own = np.array([[0.0, -4.0, np.pi / 2, 0.0]])  # its front is at the line, y = 0
    others = np.array([(x, y, 0.0, speed) for x, y, speed in cars]).reshape(-1, 4)
    env = SimpleNamespace(cars=lambda: (own, others))
    space = load(5, "gap_rule", LENGTH=8.0, WIDTH=2.0, ROW=4.0, GO=4, ACCELERATION=2.0,
                 LANES={"near": [1], "both": [1, -1]})
    return space.gap_rule(env, margin, learned, shift)(None, None)


@pytest.mark.parametrize("x, action", [
    (-47, 0), (-49, 4),  # its front is there after (47 - 8) / 10 = 3.9 s, or after 4.1 s
    (-13, 0), (-11, 4),  # its rear has left after (13 + 8) / 10 = 2.1 s, or after 1.9 s
    (30, 4),  # past already
])
def test_the_gap_rule_waits_for_cars_that_would_be_in_the_lane_with_it(x, action):
    assert rule((x, 6, 10)) == action


@pytest.mark.parametrize("x, margin, action", [(-49, 0.2, 0), (-11, 0.2, 0), (-47, -0.2, 4), (-13, -0.2, 4)])
def test_a_margin_counts_at_both_ends(x, margin, action):
    assert rule((x, 6, 10), margin=margin) == action


def test_cars_of_the_second_lane_come_from_the_other_side():
    # In the lane from sqrt(10 - 2) = 2.8 to sqrt(10 + 10) = 4.5 s: a car 30 m away is there from 2.2 to 3.8 s.
    assert rule((30, 10, 10)) == 0 and rule((-30, 10, 10)) == 4
    assert rule((30, 10, 10), learned="near") == 4  # who learned one lane watches one


@pytest.mark.parametrize("y, action", [(-2, 4), (3, 4), (5, 0), (8.5, 4), (14, 4)])
def test_only_lanes_that_are_crossed_count(y, action):
    """From the left: in the row before the nearest lane, in it, in the second one (the wrong side), beyond."""
    assert rule((-30, y, 10)) == action


def test_one_car_in_conflict_is_enough_and_no_car_is_none():
    assert rule((30, 6, 10), (-30, 6, 10)) == 0
    assert rule() == 4


def test_a_standing_car_counts_as_one_that_creeps():
    assert rule((-5, 6, 0)) == 0  # it stands in the way
    assert rule((-20, 6, 0)) == 4  # at 0.1 m/s it would take two minutes


def test_rows_counted_from_the_middle_are_shifted():
    assert rule((-30, 10, 10), shift=4.0) == 0  # the second lane stands in the row of the first at home


# ------------------------------------------------------------------------------------------------------------- copies

def success(**changes):
    """copies[network, learned, tried] of three networks: 0.9 at home, 0.5 elsewhere; left_at_right=0.8 changes one."""
    copies = np.full((3, 5, 5), 0.5)
    copies[:, range(5), range(5)] = 0.9
    for pair, value in changes.items():
        learned, tried = pair.split("_at_")
        copies[:, NAMES.index(learned), NAMES.index(tried)] = value
    return copies


def test_best_and_worst_copies_are_chosen_by_their_mean_and_never_at_home():
    copies = success(left_at_right=[0.6, 0.6, 0.6], forward_at_right=[0.9, 0.1, 0.5], challenge_at_right=0.7)
    space = load(5, "copy_at", "lead_of_single_lanes", copies=copies, names=NAMES, LINES=LINES)
    assert space.copy_at("right", "single", max).tolist() == [0.6] * 3
    assert space.copy_at("right", "single", min).tolist() == [0.9, 0.1, 0.5]
    assert space.copy_at("challenge", "multi", max).tolist() == [0.5] * 3  # Left2 alone
    assert space.lead_of_single_lanes("right") == pytest.approx([0.2, -0.6, -0.2])  # the worst less Challenge's 0.7


def test_the_matching_network_leads_over_the_best_of_the_other_four():
    copies = success(left_at_right=[0.8, 1.0, 0.9], challenge_at_right=0.85, forward_at_right=[0.5, 1.1, 0.5])
    space = load(5, "lead_over_copies", copies=copies, names=NAMES)
    leads = space.lead_over_copies(range(5))
    assert leads[:, 0] == pytest.approx([0.1, -0.1, 0])  # over Left's network, the best on average, if not of all
    assert leads[:, 1:] == pytest.approx(np.full((3, 4), 0.4))
    control = space.lead_over_copies([4, 4, 0, 4, 0])
    # Challenge's network in the place of Right's, which is a copy now (as good as Left's on average: the first counts)
    assert control[:, 0] == pytest.approx([-0.05] * 3)
    assert control[:, 4] == pytest.approx([-0.4] * 3)  # Right's network in the place of Challenge's


# -------------------------------------------------------------------------------------------------------- fine-tuning

def test_the_last_quarter_is_of_the_points_of_a_curve():
    last_quarter = load(5, "last_quarter").last_quarter
    assert last_quarter(np.arange(8.0)[None]).tolist() == [6.5]
    assert last_quarter(np.array([[[1.0, 10], [2, 20]]])).tolist() == [[2, 20]]  # never nothing
    assert last_quarter(np.arange(21.0)[None]).tolist() == [17.5]  # 15 to 20: from 18,750 of 25,000 on


PAIRS = [("left", "challenge"), ("challenge", "left"), ("left", "left2")]


def fine_tuning(start=0.6, end=0.9, alone=0.8):
    """Shares of success, collision and time-out for three pairs; the first has these, the others 0.3 and 0.7."""
    def trial(first, last):
        return {"start": same(first, 0, 0), "curve": [np.array([[first, 0, 0]] * 3 + [[last, 0, 0]])] * 3}
    entries = [({"source": source, "target": target}, trial(0.3, 0.7)) for source, target in PAIRS]
    entries[0] = (entries[0][0], trial(start, end))
    single = runs(*(({"task": task}, {"curve": [np.array([[0, 0, 0]] * 3 + [[alone, 0, 0]])] * 3}) for task in NAMES))
    space = load(5, "jump", "beyond_alone", "last_quarter", "transfer_parts", names=NAMES, LINES=LINES, single=single,
                 chance=np.array([0.1, 0.2, 0.1, 0.1, 0.4]), at_once={"challenge": 0.5, "left": 0.1, "left2": 0.4})
    return space, runs(*entries)


def test_jump_and_lead_over_learning_alone_by_hand():
    space, found = fine_tuning()
    assert space.jump(found, "left", "challenge") == pytest.approx([0.2] * 3)  # 0.6 less an untrained network's 0.4
    assert space.jump(found, "challenge", "left") == pytest.approx([0.1] * 3)
    benefit = [space.beyond_alone(found, *pair, space.last_quarter) for pair in PAIRS[:2]]
    assert benefit[0] == pytest.approx([0.1] * 3)  # 0.9 less 0.8
    assert benefit[1] == pytest.approx([-0.1] * 3)


@pytest.mark.parametrize("start, end, expected", [
    (0.6, 0.9, [1, (0.2 + 0.1 + 0.2) / 3, (0.1 + 0.2 - 0.1) / 3, 0, 1 / 3]),  # starts less those of going at once
    (0.4, 0.7, [2 / 3, (0 + 0.1 + 0.2) / 3, (-0.1 + 0.2 - 0.1) / 3, -0.1, 0]),  # as good as untrained: no jump-start
])
def test_parts_of_transfer_are_means_over_pairs_for_each_network(start, end, expected):
    space, found = fine_tuning(start, end)
    parts = space.transfer_parts(found, PAIRS)
    assert list(parts) == ["share of pairs with a jump-start", "mean jump-start",
                           "mean jump-start beyond that of going at once", "benefit at Left2 and Challenge",
                           "share of pairs that end higher"]
    assert all(values.shape == (3,) for values in parts.values())
    assert [values[0] for values in parts.values()] == pytest.approx(expected)  # benefit: not that at Left


def test_networks_are_not_mixed():
    space, found = fine_tuning()
    starts = [np.array([value, 0, 0]) for value in (0.3, 0.5, 0.9)]
    one = runs(({"source": "left", "target": "challenge"}, {"start": starts, "curve": [np.zeros((4, 3))] * 3}))
    parts = space.transfer_parts(one, [("left", "challenge")])
    assert parts["share of pairs with a jump-start"].tolist() == [0, 1, 1]
    assert parts["mean jump-start"] == pytest.approx([-0.1, 0.1, 0.5])


def test_shuffled_weights_stay_in_their_layer():
    given = np.array([1.0, 2, 3, 4, 10, 20, 100, 200, 300])
    parts = [SimpleNamespace(numel=lambda n=n: n) for n in (4, 2, 3)]
    network = SimpleNamespace(parts=[parts[:2], parts[2:]], get_weights=given.copy)
    network.set_weights = lambda weights: setattr(network, "weights", weights)
    load(5, "shuffle").shuffle(network, np.random.default_rng(1))
    layers = np.split(network.weights, [4, 6])
    assert [sorted(layer) for layer in layers] == [[1, 2, 3, 4], [10, 20], [100, 200, 300]]
    assert (network.weights != given).any()


def test_noise_moves_whole_cells_anew_for_every_image():
    scrambler = load(5, "scrambler").scrambler
    assert scrambler("trained", None) is None and scrambler("shuffled", None) is None
    image, see = np.arange(60.0).reshape(4, 5, 3), scrambler("noise", np.random.default_rng(0))
    first, second = see(image), see(image)
    assert first.shape == image.shape and (first != second).any()
    cells = [sorted(map(tuple, seen.reshape(-1, 3))) for seen in (image, first, second)]
    assert cells[0] == cells[1] == cells[2]


# ------------------------------------------------------------------------------------- too much of one task; going back

def over_training(others):
    """Scores (2 networks, 21 points of 10,000 iterations, 5 tasks); `others` (21,) at all tasks but Right's 0.9."""
    scores = np.repeat(np.repeat(np.asarray(others, float)[None, :, None], 5, axis=2), 2, axis=0)
    scores[:, :, 0] = 0.9
    scores[1] += 0.01
    places = np.linspace(0, 200, 21)
    at_once = dict(zip(NAMES, (0.8, 0.1, 0.2, 0.3, 0.4), strict=True))
    return load(5, "changes_of", scores=scores, places=places, early=places <= 30, names=NAMES,
                chance=np.array([0.5, 0.0, 0.1, 0.2, 0.3]), at_once=at_once)


def test_changes_are_between_before_the_twenties_and_the_last_twenty_thousand():
    curve = np.zeros(21)
    curve[[2, 3]] = 0.6, 0.8  # at 20,000 and 30,000 iterations
    curve[[19, 20]] = 0.4, 0.5  # 180,000 is not among the last
    curve[18] = 9
    gain, beyond, change = over_training(curve).changes_of(NAMES[1:])
    assert gain == pytest.approx([0.7 - 0.15, 0.71 - 0.15])  # untrained: (0 + 0.1 + 0.2 + 0.3) / 4
    assert beyond == pytest.approx([0.7 - 0.25, 0.71 - 0.25])  # going at once: (0.1 + 0.2 + 0.3 + 0.4) / 4
    assert change == pytest.approx([-0.25, -0.25])
    assert over_training(curve).changes_of(["right"])[2] == pytest.approx([0, 0])
    space = over_training(curve)
    assert space.changes_of(NAMES[1:], space.scores[:1])[0] == pytest.approx([0.55])


def test_leads_of_multi_lanes_are_in_success_and_in_shares_of_what_could_be_kept():
    multi = np.array([name in LINES["multi"] for name in NAMES])
    room = np.array([[0.2, 0.1, 0.5, 0.1, 0.3]])
    kept = np.array([[0.1, 0.0, 0.3, 0.0, 0.1]])
    leads = load(5, "leads_of_multi_lanes", multi=multi, room=room).leads_of_multi_lanes(kept)
    # Left2 and Challenge keep 0.4 of 0.8, the others 0.1 of 0.4.
    assert leads["retained at Left2 and Challenge minus at single lanes"] == pytest.approx([0.2 - 0.1 / 3])
    assert leads["the same in shares of what could be retained"] == pytest.approx([0.5 - 0.25])


def test_what_is_retained_where_nothing_could_be_does_not_become_a_large_share():
    multi, room = np.array([True, False]), np.array([[0.5, -0.3], [0.5, 0.3]])  # copies as good as the first task
    leads = load(5, "leads_of_multi_lanes", multi=multi, room=room).leads_of_multi_lanes(np.array([[0.1, -0.01]] * 2))
    assert leads["the same in shares of what could be retained"] == pytest.approx([0.2 + 0.5] * 2)


# ----------------------------------------------------------------------------------------------------- the recording

def test_time_to_learn_is_the_first_point_above_ninety_percent_or_the_whole_budget():
    training = np.array([[0, 0.5, 0.9, 0.2], [0.95, 0, 0, 0], [0, 0.89, 0.89, 0.89]])
    scores = np.stack([training, np.ones((3, 4))], axis=2)  # what happens on the test recording does not count
    assert load(5, "time_to_learn").time_to_learn(scores).tolist() == [2, 0, 3]


def recorded(pretrained, scratch, noise):
    """Scores (networks, 11 points, recordings, outcomes) by start, from a (training, test) curve a network."""
    def scores(curves):
        return np.stack([np.stack(curve, axis=-1)[..., None] * [1, 0, 0] for curve in curves])
    starts = {"simulation": scores(pretrained), "scratch": scores(scratch), "noise": scores(noise)}
    return load(5, "recorded_parts", "time_to_learn", "last_quarter",
                recorded=SimpleNamespace(stack=lambda key, start: starts[start]))


def step(at, level):
    return np.where(np.arange(11) >= at, level, 0.2)


def test_parts_of_learning_from_a_recording_by_hand():
    scratch = [(step(at, 0.95), step(3, 0.6)) for at in (4, 5, 9)]  # 6 points on average
    noise = [(step(1, 0.95), step(1, 0.7))] * 3
    space = recorded([(step(at, 0.95), step(at, 0.8)) for at in (1, 3, 6)], scratch, noise)
    parts = {label: pytest.approx(values.tolist()) for label, values in space.recorded_parts("simulation").items()}
    assert parts == {
        "iterations to 90 % on the training recording, pre-trained over from scratch": [1 / 6, 3 / 6, 1],
        "test recording: success of the pre-trained network at the end": [0.8] * 3,
        "training recording: success of the direct copy": [0.2] * 3,
        # Points 1 to 10: 0.8 ten, eight and five times, else 0.2; from scratch 0.6 eight times, else 0.2; noise 0.7.
        "test recording, mean over the curve: pre-trained minus from scratch": [0.8 - 0.52, 0.68 - 0.52, 0.5 - 0.52],
        "test recording, best of the curve: pre-trained minus from scratch": [0.2] * 3,
        "test recording, mean over the curve: pre-trained minus the control": [0.1, 0.68 - 0.7, 0.5 - 0.7],
        "test recording, best of the curve: pre-trained minus the control": [0.1] * 3}
    own = space.recorded_parts("noise")  # the control leads over itself by nothing, and is not asked
    assert not own["test recording, mean over the curve: pre-trained minus the control"].any()


def test_what_was_known_before_anything_was_seen_of_the_recording_is_no_lead():
    flat = [(np.full(11, 0.5), np.full(11, 0.5))] * 3
    early = [(np.full(11, 0.5), np.where(np.arange(11) == 0, 0.4, 0.5))] * 3
    lead = recorded(early, flat, flat).recorded_parts("simulation")
    assert lead["test recording, mean over the curve: pre-trained minus from scratch"].tolist() == [0] * 3


def test_who_knows_from_the_start_needs_no_time_and_nobody_divides_by_none():
    known = [(np.full(11, 0.95), np.full(11, 0.8))] * 3
    (ratio, *_) = recorded(known, known, known).recorded_parts("simulation").values()
    assert ratio.tolist() == [0] * 3
