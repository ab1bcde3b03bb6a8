"""Chapter 6, lives at the junctions: functions that make memories and decide claims, on numbers made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from notebook_functions import code_cells, judge, load, run_cell, runs

from lifelong_lib.learners.q_learning import ReplayBuffer
from lifelong_lib.reproduction.files import ReproductionError
from lifelong_lib.transfer.replay import CoverageMemory, EpisodicMemory, PairOfBuffers

NAMES = ["right", "left", "left2", "forward", "challenge"]
ORDER = "forward challenge left left2 right"
RNG = np.random.default_rng(0)


# ----------------------------------------------------------------------------------------------------------- memories

def memory(strategy, ranking=None, errors=None, **more):
    config = {"strategy": strategy, "kept": 6, "recent": 3, "refreshed": False, "spread": 0.5, "eta": 0.1} | more
    space = load(6, "make_memory", "ranking_of", "least_surprise", "latest", "NO_MEMORY")
    return space.make_memory(config, (1,), np.random.default_rng(0), ranking, [] if errors is None else errors)


def trial(*returns):
    points, nothing = np.zeros((len(returns) + 1, 1), np.float32), np.zeros(len(returns), int)
    return SimpleNamespace(images=points, masks=np.ones((len(points), 2)), actions=nothing, rewards=nothing,
                           steps=nothing, returns=np.array(returns, float), info={})


class Guess:
    """A network that estimates all returns to be zero."""

    @staticmethod
    def values(images):
        return np.zeros((len(images), 2))


@pytest.mark.parametrize("strategy, kind", [
    ("surprise", EpisodicMemory), ("reward", EpisodicMemory), ("matching", EpisodicMemory), ("latest", EpisodicMemory),
    ("least surprise", EpisodicMemory), ("coverage", CoverageMemory)])
def test_what_is_selected_stands_beside_the_latest_also_while_both_are_empty(strategy, kind):
    pair = memory(strategy)
    assert isinstance(pair, PairOfBuffers) and type(pair.long_term) is kind
    assert (len(pair.long_term.returns), len(pair.recent.returns)) == (6, 3)
    assert type(memory(strategy, recent=0)) is kind  # the long-term memory alone


@pytest.mark.parametrize("strategy", ["FIFO", "unlimited", "no long-term memory"])
def test_without_selection_there_is_one_buffer(strategy):
    assert type(memory(strategy, kept=0, recent=7)) is ReplayBuffer and len(memory(strategy, recent=7).returns) == 7


@pytest.mark.parametrize("strategy, stays", [
    ("surprise", [4, 5, 6, 7, 8, 9]), ("least surprise", [0, 1, 2, 3, 4, 5]), ("latest", [9, 8, 7, 6, 5, 4])])
def test_what_a_memory_keeps(strategy, stays):
    errors, order = [], range(10)
    held = memory(strategy, errors=errors)
    held.add(trial(*order), Guess)
    assert sorted(held.long_term.returns) == sorted(stays)
    assert np.concatenate(errors).tolist() == list(order)  # the network estimates zero
    assert sorted(held.recent.returns) == [7, 8, 9]


def test_the_latest_are_kept_over_trials_whatever_they_are_worth():
    held = memory("latest")
    for returns in ([9, 9, 9], [1, 2], [3, 4, 5, 6]):
        held.add(trial(*returns), Guess)
    assert sorted(held.long_term.returns) == [1, 2, 3, 4, 5, 6]


def test_a_ranking_of_ones_own_takes_the_place_of_the_strategys():
    held = memory("no such strategy", ranking=lambda trial, network, rng: -trial.returns)
    held.add(trial(*range(10)), Guess)
    assert sorted(held.long_term.returns) == [0, 1, 2, 3, 4, 5]


def test_fading_prefers_the_young_by_a_factor_of_e_for_ten_thousand():
    ranking = load(6, "fading").fading()
    old, young = ranking(trial(*[0] * 20_000), None, RNG), ranking(trial(*[0] * 20_000), None, RNG)
    assert np.mean(young) - np.mean(old) == pytest.approx(2, abs=0.05)  # 20,000 younger
    share = np.mean(young[:1000] > old[:1000])  # a Gumbel beats another that is 2 behind with e^2 / (1 + e^2)
    assert share == pytest.approx(np.exp(2) / (1 + np.exp(2)), abs=0.05)


@pytest.mark.parametrize("own, tried", [("", []), ("one", ["one"]), (" two  one ", ["two", "one"])])
def test_rankings_that_are_asked_for(own, tried):
    assert load(6, "asked_for").asked_for(own, {"one": None, "two": None}) == tried


def test_an_unknown_ranking_is_refused_in_one_line_that_names_the_known():
    with pytest.raises(ReproductionError, match="^no ranking foo, bar in OWN: own may name one, two, or nothing$"):
        load(6, "asked_for").asked_for("foo one bar", {"one": None, "two": None})


def test_an_unknown_ranking_is_refused_before_any_grid():
    sources = list(code_cells(6))
    refused = next(place for place, source in enumerate(sources) if "tried = asked_for(own, OWN)" in source)
    assert refused < next(place for place, source in enumerate(sources) if "run_grid(chapter" in source)


@pytest.mark.parametrize("tried", [[], ["one"]])
def test_without_a_ranking_of_ones_own_there_is_no_figure_and_no_run(tried):
    asked, drawn = [], []
    space = SimpleNamespace(tried=tried, selective={}, chapter=None, JUNCTIONS=[], live=None, OWN={},
                            panels=lambda count, **size: (None, [None] * count), legend=lambda fig: drawn.append(fig),
                            draw_life=lambda *what: None)  # fmt: skip
    space.run_grid = lambda chapter, name, *more, **known: asked.append(name) or runs(
        ({"strategy": "one"}, {"scores": [np.zeros((2, 5))]}))
    run_cell(6, "owned = run_grid(", space)
    assert asked == ["own"] * len(tried) and drawn == [None] * len(tried)


def test_the_share_that_a_memory_keeps_of_the_first_and_the_last():
    space = load(6, "share_kept", "latest", "as_trial")
    assert space.share_kept(space.latest, RNG, memories=2) == (0, 1)
    constant = space.share_kept(lambda: lambda trial, network, rng: np.zeros(len(trial.returns)), RNG, memories=400)
    assert constant == pytest.approx((0.1, 0.1), abs=0.01)  # equal scores: a random key decides


@pytest.mark.parametrize("kind, arrivals", [("ranked", [0, 3, 4, 9, 7, 0]), ("latest ones", None)])
def test_whose_experiences_a_memory_holds(kind, arrivals):
    space = load(6, "held_by_junction", names=NAMES)
    stored = SimpleNamespace(added=10, arrivals=np.array(arrivals)) if arrivals else SimpleNamespace(added=10)
    held = type("Held", (SimpleNamespace,), {"__len__": lambda self: 5})(**vars(stored))
    counts = space.held_by_junction(held, [0, 4, 8], ["forward", "right", "forward"])  # experiences 0-3, 4-7, 8 on
    # Ranked: 0, 3 and 9 are of Forward, 4 and 7 of Right (the sixth place is empty). Latest ones: 5 to 9.
    assert counts.tolist() == ([2, 0, 0, 3, 0] if arrivals else [3, 0, 0, 2, 0])
    pair = SimpleNamespace(long_term=held)
    assert space.held_by_junction(pair, [0, 4, 8], ["forward", "right", "forward"]).tolist() == counts.tolist()


def test_errors_in_fifty_stretches():
    summary = load(6, "summary_of").summary_of(np.repeat([0.25, 0.75], 100))
    assert summary.shape == (50, 2) and summary[:25].tolist() == [[0.25, 0]] * 25
    assert summary[25:].tolist() == [[0.75, 1]] * 25
    assert load(6, "summary_of").summary_of(np.array([0.6])).tolist() == [[0.6, 1]]


# ------------------------------------------------------------------------------------------------------------- claims

def life_of(start, *after):
    """Results of a life from success at the five junctions, in ORDER, at the start and after each of them."""
    columns = [ORDER.split().index(name) for name in NAMES]
    ends = np.array(after, float)[:, columns]
    return {"scores": [np.array([start], float)[:, columns]] * 3, "ends": [ends] * 3}


LEARNS = [[0.2 if i < j else 0.9 for j in range(5)] for i in range(5)]  # each junction, for good
FORGETS = [[0.9 if i == j else 0.2 for j in range(5)] for i in range(5)]  # knows the present one only


def space_of(**found):
    """The functions of C6.1 to C6.4, with lives by strategy, and networks that learned one junction: 0.9 each."""
    configs = {name: {"strategy": name} for name in found}
    lives = runs(*((configs[name], result) for name, result in found.items()))
    return load(6, "by_order", "of", "measures_of", "at_the_end", "unlimited_parts", "change_during", "NO_MEMORY",
                "forgetting_parts", "backward", "transfer_parts", "near_unlimited", "stood_in", "RANKED", names=NAMES,
                order=ORDER, lives=lives, STRATEGIES=configs, alone=np.full((3, 5), 0.9))  # fmt: skip


def typical(**other):
    good, bad = life_of([0.2] * 5, *LEARNS), life_of([0.2] * 5, *FORGETS)
    found = dict.fromkeys(("unlimited", "coverage", "matching"), good)
    forgetful = ("FIFO", "surprise", "reward", "latest", "no long-term memory")
    return space_of(**found | dict.fromkeys(forgetful, bad) | other)


def test_measures_are_in_the_order_of_the_life():
    space = typical()
    assert space.by_order(np.array([1, 2, 3, 4, 5]), ORDER).tolist() == [4, 5, 2, 3, 1]
    keeps, loses = space.measures_of("unlimited"), space.measures_of("FIFO")
    assert keeps["backward transfer"] == pytest.approx([0] * 3)
    assert keeps["average accuracy"] == pytest.approx([0.9] * 3)
    assert loses["backward transfer"] == pytest.approx([-0.7] * 3) and loses["forgetting"] == pytest.approx([0.7] * 3)
    assert loses["average accuracy"] == pytest.approx([(0.9 + 4 * 0.2) / 5] * 3)


def test_what_a_junction_does_to_others():
    space = typical()
    # Challenge is second: of the single lanes Forward falls from 0.9 to 0.2, Left and Right stay at 0.2.
    assert space.change_during("FIFO", "challenge", ("right", "left", "forward")) == pytest.approx([-0.7 / 3] * 3)
    # Right is last: of the others Left2 falls. And the first junction's change is from the start.
    assert space.change_during("FIFO", "right", NAMES[1:]) == pytest.approx([-0.7 / 4] * 3)
    assert space.change_during("FIFO", "forward", ["forward"]) == pytest.approx([0.7] * 3)


@pytest.mark.parametrize("identity", ["C6.1", "C6.2", "C6.3", "C6.4"])
def test_the_thesiss_world_holds_with_a_failing_control(identity, tmp_path):
    claim = judge(6, identity, typical(), tmp_path)
    assert claim.verdict == "holds" and claim.control_verdict == "contradicted"


GOOD, BAD = life_of([0.2] * 5, *LEARNS), life_of([0.2] * 5, *FORGETS)


@pytest.mark.parametrize("identity, strategy, life", [
    ("C6.1", "unlimited", BAD), ("C6.2", "FIFO", GOOD), ("C6.3", "surprise", GOOD), ("C6.3", "reward", GOOD),
    ("C6.3", "coverage", BAD), ("C6.3", "matching", BAD), ("C6.4", "matching", BAD), ("C6.4", "coverage", BAD)])
def test_each_part_can_contradict(identity, strategy, life, tmp_path):
    assert judge(6, identity, typical(**{strategy: life}), tmp_path).verdict == "contradicted"


@pytest.mark.parametrize("identity", ["C6.1", "C6.3", "C6.4"])
@pytest.mark.parametrize("control", ["FIFO", "latest", "no long-term memory"])
def test_a_control_without_anything_old_that_keeps_all_the_same_leaves_no_verdict(identity, control, tmp_path):
    none = "no long-term memory"
    used = {"C6.1": ("FIFO", none), "C6.3": ("latest",), "C6.4": ("FIFO", "latest", none)}[identity]
    verdict = judge(6, identity, typical(**{control: GOOD}), tmp_path).verdict
    assert verdict == ("undecided" if control in used else "holds")


def test_each_junction_that_is_hurt_stands_beside_the_mean(tmp_path):
    parts = typical().forgetting_parts("FIFO")
    single = {label: found[0] for label, found in parts.items() if "Challenge is learned" in label}
    # Challenge is second: Forward falls from 0.9 to 0.2, Left and Right stay at 0.2. Right is last: Left2 falls.
    assert single == pytest.approx({f"while Challenge is learned: change at {name}": change for name, change in
                                    [("Right", 0), ("Left", 0), ("Forward", -0.7), ("single lanes", -0.7 / 3)]})
    assert parts["while Right is learned: change at Left2"] == pytest.approx([-0.7] * 3)
    assert parts["while Right is learned: change at Challenge"] == pytest.approx([0] * 3)
    assert judge(6, "C6.2", typical(), tmp_path).verdict == "holds"  # though some of them do not fall


def order_space(fifo, unlimited):
    """The functions that choose an order, with lives in the orders of `fifo`: {order: success after each junction}."""
    both = {}
    for order, knows in fifo.items():
        columns = [order.split().index(name) for name in NAMES]
        for strategy, ends in (("FIFO", knows), ("unlimited", unlimited)):
            both[(order, strategy)] = {"scores": [np.full((1, 5), 0.2)] * 2, "ends": [np.array(ends)[:, columns]] * 2}
    looked = runs(*(({"order": order, "strategy": name}, found) for (order, name), found in both.items()))
    return load(6, "by_order", "measures_in", "order_row", "check_order", names=NAMES, looked=looked)


OTHER = "forward challenge right left left2"


def test_the_order_in_use_is_the_one_in_which_fifo_forgets_more():
    space = order_space({ORDER: FORGETS, OTHER: LEARNS}, LEARNS)
    space.check_order(ORDER, (ORDER, OTHER), space.looked)
    with pytest.raises(ReproductionError, match=f"-p order='{ORDER}'$") as refused:
        space.check_order(OTHER, (ORDER, OTHER), space.looked)
    assert "\n" not in str(refused.value)
    with pytest.raises(ReproductionError, match=f"-p order='{OTHER}'$"):
        space = order_space({ORDER: LEARNS, OTHER: FORGETS}, FORGETS)  # what the unlimited memory does has no part
        space.check_order(ORDER, (ORDER, OTHER), space.looked)


def test_the_table_of_orders_has_both_memories():
    row = order_space({ORDER: FORGETS, OTHER: LEARNS}, LEARNS).order_row(ORDER)
    assert row == {"order": ORDER, "FIFO, forgetting": "0.700 ± 0.000", "FIFO, average accuracy": "0.340 ± 0.000",
                   "unlimited, forgetting": "0.000 ± 0.000", "unlimited, average accuracy": "0.900 ± 0.000"}


@pytest.mark.parametrize("profile, refused", [("paper", True), ("quick", False), ("smoke", False)])
def test_only_paper_insists_on_the_order(profile, refused):
    space = order_space({ORDER: FORGETS, OTHER: LEARNS}, LEARNS)
    given = SimpleNamespace(**vars(space), profile=profile, order=OTHER, orders=(ORDER, OTHER))
    if refused:
        with pytest.raises(ReproductionError):
            run_cell(6, "def check_order", given)
    else:
        run_cell(6, "def check_order", given)


def contents(**held):
    """The functions of C6.7 and C6.8, with what memories hold at the end, in the order of NAMES."""
    configs = {name: {"strategy": name} for name in held}
    lives = runs(*((configs[name], {"held": [np.array([[1] * 5, stored]) for stored in each],
                                    "ends": [np.full((5, 5), 0.5)] * len(each)}) for name, each in held.items()))
    return load(6, "by_order", "of", "shares_held", "spread_held", "unfairness", "old_held", "before_the_last",
                "at_the_end", "varies_more", "pattern_parts", "RANKED", names=NAMES, order=ORDER, hard=[2, 4],
                lives=lives, STRATEGIES=configs)  # fmt: skip


FAIR, LAST = [[18, 18, 22, 18, 24]] * 6, [[100, 0, 0, 0, 0]] * 6
SURPRISED = [[4, 10, 40, 3, 43]] * 6
APART = [[0, 0, 100, 0, 0], [0, 0, 0, 0, 100]] * 3
VARIED = [[40, 10, 20, 5, 25], [5, 40, 5, 25, 25], [40, 5, 5, 25, 25]] * 2


def test_shares_of_a_memory_by_hand():
    space = contents(one=[[10, 0, 30, 20, 40]], two=[[0, 0, 50, 0, 50], [50, 0, 0, 0, 50]])
    assert space.shares_held("one") == pytest.approx(np.array([[0.1, 0, 0.3, 0.2, 0.4]]))
    assert space.unfairness("one") == pytest.approx([0.2])
    assert space.old_held("one") == pytest.approx([0.2 + 0.4 + 0])  # Forward, Challenge, Left
    assert space.spread_held("two") == pytest.approx([0.1, 0.1])  # 0.25 off at two of five
    assert space.before_the_last("one") == pytest.approx([0.9])  # all but Right


def test_coverage_is_held_against_the_one_whose_lives_differ_most():
    space = contents(coverage=VARIED, surprise=FAIR, reward=[[0, 0, 50, 0, 50], [50, 0, 0, 0, 50]] * 3, matching=FAIR)
    difference = space.spread_held("coverage") - 0.1
    assert space.varies_more("coverage") == pytest.approx(difference)


@pytest.mark.parametrize("change, verdict", [
    ({}, "holds"), ({"surprise": FAIR}, "contradicted"), ({"matching": LAST}, "contradicted"),
    ({"reward": LAST}, "contradicted"), ({"coverage": FAIR, "matching": VARIED}, "contradicted"),
    ({"surprise": APART}, "contradicted")])  # surprise's lives differ more than coverage's
def test_the_pattern_of_the_table(change, verdict, tmp_path):
    held = {"surprise": SURPRISED, "reward": FAIR, "coverage": VARIED, "matching": FAIR, "latest": LAST}
    claim = judge(6, "C6.8", contents(**held | change), tmp_path)
    assert claim.verdict == verdict
    if not change:
        assert claim.control_verdict == "contradicted"


def test_refreshing_empties_and_what_the_thesis_mentions_is_worse(tmp_path):
    held = dict.fromkeys(("surprise", "matching", "least surprise", "reward with more noise"), FAIR)
    space = contents(**held | {"refreshed surprise": LAST, "long-term memory alone": FAIR})
    claim = judge(6, "C6.7", space, tmp_path)
    assert claim.verdict == "contradicted" and claim.control_verdict == "contradicted"  # all lives end at 0.5 here
    old, emptied, *successes = claim.measured.values()
    assert old == pytest.approx(0 - 0.6) and emptied == 0 and successes == [0, 0, 0]
    assert claim.control["refreshed: share of all junctions but the last"] == pytest.approx(0.82)
    success = {"surprise": 0.6, "refreshed surprise": 0.3, "long-term memory alone": 0.5, "least surprise": 0.4}
    space.at_the_end = lambda name: np.full(6, success.get(name, 0.8))
    assert judge(6, "C6.7", space, tmp_path).verdict == "holds"


def test_a_memory_that_keeps_much_of_old_junctions_is_not_empty(tmp_path):
    held = dict.fromkeys(("surprise", "matching", "least surprise", "reward with more noise"), FAIR)
    left = [[80, 0, 20, 0, 0]] * 6  # a fifth is of another junction than the last
    space = contents(**held | {"refreshed surprise": left, "long-term memory alone": FAIR})
    success = {"surprise": 0.6, "refreshed surprise": 0.3, "long-term memory alone": 0.5, "least surprise": 0.4}
    space.at_the_end = lambda name: np.full(6, success.get(name, 0.8))
    assert judge(6, "C6.7", space, tmp_path).verdict == "contradicted"


def test_unbalanced_lives_by_hand():
    ends = {"coverage": [(0.8, 0.5), (0.8, 0.6)], "matching": [(0.4, 0.5), (0.8, 0.5)]}  # Right, Challenge at the end
    found = runs(*(({"strategy": name}, {"ends": [np.array([[0, 0], pair]) for pair in each]})
                   for name, each in ends.items()))
    configs = {name: {"strategy": name} for name in ends}
    parts = load(6, "unbalanced_parts", two_tasks=found, unbalanced_of=configs).unbalanced_parts("coverage", "matching")
    right, challenge, apart = parts.values()
    assert right == pytest.approx([0.4, 0]) and challenge == pytest.approx([0, 0.1])
    assert apart == pytest.approx([0.2] * 2)


def test_what_memories_hold_of_right_after_unbalanced_lives():
    held = [np.array([[5, 0, 0, 0, 0], [1, 0, 0, 0, 4]]), np.array([[5, 0, 0, 0, 0], [2, 0, 0, 0, 2]])]
    found = runs(({"strategy": "coverage"}, {"held": held}))
    space = load(6, "right_held", two_tasks=found, unbalanced_of={"coverage": {"strategy": "coverage"}}, names=NAMES)
    assert space.right_held("coverage") == pytest.approx([0.2, 0.5])


def test_the_control_of_large_errors_explores_nothing_and_differs_in_nothing_else_that_counts():
    asked = []
    matching = {"strategy": "matching", "epsilon": 0.05, "looks": 20, "trials": 100, "order": ORDER, "watched": ORDER}
    space = SimpleNamespace(STRATEGIES={"matching": matching}, unwatched={"looks": 1, "trials": 1}, names=NAMES,
                            chapter=None, junction_life=None, JUNCTIONS=[], errors=np.zeros((1, 5, 2)),
                            check_claim=lambda *claim: None, run_grid=lambda *grid, **more: asked.append(grid) or runs(
                                ({}, {"errors": [np.zeros((5, 2))]})))  # fmt: skip
    run_cell(6, '"nothing-new"', space)
    (config,) = asked[0][3]
    assert config == matching | {"epsilon": 0, "looks": 1, "trials": 1, "order": " ".join(["right"] * 5),
                                 "watched": "right"}  # fmt: skip


def test_a_life_keeps_the_weights_of_its_beginning_of_its_first_junction_and_of_its_end():
    class Learner:
        """Its weights are the number of its iterations."""

        def __init__(self):
            self.iterations, self.memory, self.network = 0, ReplayBuffer(9, (1,)), SimpleNamespace(
                get_weights=lambda: np.array([self.iterations]))

        def train(self, env, iterations):
            self.iterations += iterations

    junction = SimpleNamespace(close=lambda: None)
    space = load(6, "live", "held_by_junction", names=NAMES, new_learner=lambda *given: (Learner(), []),
                 Intersection=lambda *given: junction, look=lambda *given: np.zeros(5))
    config = {"order": ORDER, "rounds": 2, "lengths": "10 10 10 10 10", "every": 10, "looks": 1, "trials": 1,
              "coordinates": "global", "discount": 0.99}  # fmt: skip
    results, _, weights = space.live(config, np.random.SeedSequence(0))
    assert np.ravel(weights).tolist() == [0, 10, 100]
    assert len(results["scores"]) == 11 and len(results["held"]) == 10 and len(results["ends"]) == 5


def test_the_smallest_share_of_large_errors_in_a_fifth_of_a_life():
    errors = np.zeros((1, 10, 2))
    errors[0, :, 1] = [0.5, 0.4, 0.1, 0.1, 0.02, 0.04, 0.2, 0.2, 0.3, 0.3]
    assert load(6, "least_share").least_share(errors) == pytest.approx([0.03])


def test_what_is_drawn_of_a_space_is_worth_what_it_says():
    value_of = load(6, "value_of").value_of
    assert value_of(np.array([[0.5, 0.4], [0.5, 0.81], [-0.5, -0.1], [0, 0]])).tolist() == [1, 0, -1, 0]
