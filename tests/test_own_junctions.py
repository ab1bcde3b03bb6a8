"""Junctions of one's own: a plan or a map becomes files that SUMO drives on, and what does not fit is one line."""

import shutil
from importlib.util import module_from_spec, spec_from_file_location

import gymnasium as gym
import numpy as np
import pytest
from conftest import REPOSITORY, trial
from gymnasium.utils.env_checker import check_env

from lifelong_lib.environments.crossing import GO
from lifelong_lib.environments.intersections import TASKS, Intersection
from lifelong_lib.environments.safe_junction import SafeJunction
from lifelong_lib.environments.sumo import checked

FOLDER = REPOSITORY / "data" / "own_junctions"
OWN = {"wide": "forward", "village": "left"}
each = pytest.mark.parametrize(("name", "task"), OWN.items())

# What netconvert makes of village.osm, in its plain format.
NODES = """<nodes><location netOffset="-356509.63,-5540493.53" convBoundary="0.00,0.00,290.63,156.87"/>
<node id="1" x="161.25" y="53.84" type="priority"/><node id="3" x="290.63" y="107.33" type="dead_end"/>
<node id="5" x="0.00" y="0.00" type="dead_end"/><node id="8" x="122.79" y="156.87" type="dead_end"/></nodes>"""
EDGE = '<edge id="{}" from="{}" to="{}" numLanes="1" speed="{}" shape="{}"/>'
EDGES = "<edges>" + "".join([
    EDGE.format("-100#0", 1, 5, 19.44, "161.25,53.84 111.60,30.19 0.00,0.00"),
    EDGE.format("-100#1", 3, 1, 19.44, "290.63,107.33 214.96,80.57 161.25,53.84"),
    EDGE.format("-200", 8, 1, 13.89, "122.79,156.87 125.50,119.75 143.41,77.95 161.25,53.84"),
    EDGE.format("100#0", 5, 1, 19.44, "0.00,0.00 111.60,30.19 161.25,53.84"),
    EDGE.format("100#1", 1, 3, 19.44, "161.25,53.84 214.96,80.57 290.63,107.33"),
    EDGE.format("200", 1, 8, 13.89, "161.25,53.84 143.41,77.95 125.50,119.75 122.79,156.87"),
]) + "</edges>"  # fmt: skip


def script():
    spec = spec_from_file_location("own_build", FOLDER / "build.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def own(tmp_path, monkeypatch):
    """The script, which writes into a folder of its own, where there is the map."""
    module = script()
    for name in ("intersections", "safe_junction"):
        (tmp_path / name).mkdir()
        shutil.copyfile(REPOSITORY / "data" / name / "build.py", tmp_path / name / "build.py")
    module.HERE = tmp_path / "own_junctions"
    module.HERE.mkdir()
    shutil.copyfile(FOLDER / "village.osm", module.HERE / "village.osm")
    return module


@pytest.fixture
def drive():
    made = []

    def make(name, task):
        made.append(Intersection(task, "global", folder=FOLDER / name))
        return made[-1]

    yield make
    for env in made:
        env.close()


# ---------------------------------------------------------------------------------------------------------------- files

def test_a_plan_is_one_line_and_its_sources_are_those_that_are_here(own):
    plan = own.script("intersections")
    for kind, text in plan.sources(*own.PLANS["wide"]).items():
        assert text == (FOLDER / "wide" / f"forward.{kind}.xml").read_text()


def test_a_map_becomes_the_sources_that_are_here(own):
    file, junction, start, goal = own.MAPS["village"]
    task, parts = own.map_sources(own.read_arms(NODES, EDGES, junction), start, goal, own.script("intersections"))
    assert file == "village.osm" and task == "left"
    for kind, text in parts.items():
        assert text == (FOLDER / "village" / f"left.{kind}.xml").read_text()


def star(*bearings, lanes=1):
    """Plain files of a junction of straight arms of 100 m, all of two ways."""
    ends = [(100 * np.sin(np.deg2rad(b)), 100 * np.cos(np.deg2rad(b))) for b in bearings]
    nodes = "".join(f'<node id="{i}" x="{x:.6f}" y="{y:.6f}"/>' for i, (x, y) in enumerate([(0, 0), *ends]))
    edges = "".join(f'<edge id="{a}" from="{i * (a == "in")}" to="{i * (a == "out")}" numLanes="{lanes}" speed="10"/>'
                    for i in range(1, len(ends) + 1) for a in ("in", "out"))  # fmt: skip
    return f"<nodes>{nodes}</nodes>", f"<edges>{edges}</edges>", "0"


@pytest.mark.parametrize("turn", [0, 77, 200])
@pytest.mark.parametrize(("goal", "end"), [(90, "to_east"), (270, "to_west"), (0, "to_north")])
def test_wherever_north_is_the_car_comes_from_the_south(own, turn, goal, end):
    """By hand: a right-angled cross; arms are then on the axes, 250 m and 60 m long."""
    arms = own.read_arms(*star(*(np.array([0, 90, 180, 270]) + turn) % 360, lanes=2))
    task, parts = own.map_sources(arms, (180 + turn) % 360, (goal + turn) % 360, own.script("intersections"))
    assert task == {"to_east": "right", "to_west": "left", "to_north": "forward"}[end]
    for name, x, y in (("east", 250, 0), ("west", -250, 0), ("north", 0, 60), ("south", 0, -60)):
        (line,) = (line for line in parts["nod"].splitlines() if f'"{name}"' in line)
        assert [float(word) for word in line.split('"')[3:6:2]] == pytest.approx([x, y], abs=0.01)
    assert f'edges="from_south {end}"' in parts["rou"] and parts["rou"].count("<flow") == 4


def test_an_arm_is_cut_or_continued_to_its_length(own):
    """By hand: a line of 30 m and 40 m at right angles."""
    line = np.array([[0, 0], [0, 30], [40, 30]])
    assert own.fitted(line, 50, 90).tolist() == [[0, 0], [0, 30], [20, 30]]
    assert own.fitted(line, 100, 90).tolist() == [[0, 0], [0, 30], [70, 30]]
    assert own.fitted(line, 20, 90).tolist() == [[0, 0], [0, 20]]
    assert own.fitted(line, 50, 0).tolist() == [[0, 0], [30, 0], [30, -20]]  # north is the x axis


@pytest.mark.skipif(shutil.which("netconvert") is None, reason="netconvert is not installed (eclipse-sumo)")
@each
def test_netconvert_makes_the_files_that_are_here(own, name, task):
    own.build(name)
    made = {path.name: path.read_bytes() for path in (own.HERE / name).iterdir()}
    assert made == {path.name: path.read_bytes() for path in (FOLDER / name).iterdir()}


# -------------------------------------------------------------------------------------------------------------- driving

@each
def test_gymnasium_finds_nothing_to_complain_of(name, task):
    env = gym.make("lifelong_lib/Intersection-v0", task=task, folder=FOLDER / name)
    check_env(env.unwrapped)
    env.close()


@each
def test_a_car_that_goes_blindly_collides_and_not_always(drive, name, task):
    env = drive(name, task)
    ends = [trial(env, seed, [GO])[-1][4] for seed in range(24)]
    assert {info["outcome"] for info in ends} == {"success", "collision"}
    assert all(15 <= info["steps"] <= 40 for info in ends if info["outcome"] == "success")
    seed = next(seed for seed, info in enumerate(ends) if info["outcome"] == "success")
    steps = [np.concatenate([step[0].ravel(), step[1:2]]) for step in trial(env, seed, [1, GO])[1:]]
    again = [np.concatenate([step[0].ravel(), step[1:2]]) for step in trial(env, seed, [1, GO])[1:]]
    np.testing.assert_array_equal(steps, again)
    trial(env, seed, [GO])
    assert env.sumo.way_on(TASKS[task]) >= 10


def test_the_main_road_is_seen_where_the_plan_has_it(drive):
    """Two lanes a direction about the middle are rows 7 to 10; one of two lanes that bends is seen in more than 2."""
    rows = {}
    for name, task in OWN.items():
        env = drive(name, task)
        seen = sum(env.reset(seed=seed)[0][:, :, 2] for seed in range(4))
        rows[name] = set(np.flatnonzero(seen.any(axis=1)).tolist())
        env.close()
    assert rows["wide"] == {7, 8, 9, 10}
    assert rows["village"] > {8, 9}


def test_chapter_seven_drives_on_a_map_and_its_mask_keeps_it_safe():
    env, ends = SafeJunction(0.1, folder=FOLDER / "village"), []
    for seed in range(4):
        _, info = env.reset(seed=seed)
        while not info.get("outcome"):
            *_, info = env.step(int(np.flatnonzero(info["action_mask"])[-1]))
        ends.append(info["outcome"])
    env.close()
    assert ends == ["success"] * 4


# ------------------------------------------------------------------------------------------------------------ bad input

@pytest.mark.parametrize(("bearings", "start", "goal", "said"), [
    ((0, 90, 180, 270), 180, 225, "no arm near bearing 225; there are 0, 90, 180, 270"),
    ((0, 90, 180, 270), 180, 185, "bearings 180 and 185 are the same arm"),
    ((0, 180), 180, 0, "a junction of 3 or 4 arms is wanted, this one has 2"),
    ((0, 45, 90, 180, 270), 180, 0, "a junction of 3 or 4 arms is wanted, this one has 5"),
    ((0, 90, 180), 180, 0, "the main road must pass from the left to the right of where the ego car comes from"),
])  # fmt: skip
def test_a_map_that_does_not_fit_is_one_line(own, bearings, start, goal, said):
    with pytest.raises(SystemExit, match=f"^error: {said}$"):
        own.map_sources(own.read_arms(*star(*bearings)), start, goal, own.script("intersections"))


def test_one_way_roads_and_unknown_nodes_are_one_line(own):
    nodes, edges, junction = star(0, 90, 180, 270)
    with pytest.raises(SystemExit, match="^error: no junction '7' on the map; it has 0, 1, 2, 3, 4$"):
        own.read_arms(nodes, edges, "7")
    out = edges.replace('<edge id="in" from="3" to="0" numLanes="1" speed="10"/>', "")  # nobody comes from the south
    with pytest.raises(SystemExit, match="^error: the ego car would drive against a one-way road$"):
        own.map_sources(own.read_arms(nodes, out, junction), 180, 90, own.script("intersections"))
    twice = edges.replace('<edge id="in" from="3"', '<edge id="more" from="3" to="0" numLanes="1" speed="10"/>'
                          '<edge id="in" from="3"')  # fmt: skip
    with pytest.raises(SystemExit, match="^error: two roads lead from the junction to 3: a single one is wanted$"):
        own.read_arms(nodes, twice, junction)


def test_a_name_a_file_or_a_program_that_is_missing_is_one_line(own, monkeypatch):
    with pytest.raises(SystemExit, match="^error: no junction 'bay' in PLANS or MAPS; they have wide, village$"):
        own.build("bay")
    own.MAPS["bay"] = ("bay.osm", "1", 0, 90)
    with pytest.raises(SystemExit, match="^error: bay.osm is not in this folder$"):
        own.build("bay")
    monkeypatch.setattr("sys.executable", "/nowhere/python")
    monkeypatch.setenv("PATH", "")
    with pytest.raises(SystemExit, match="^error: netconvert is missing: pip install eclipse-sumo==1.28.0$"):
        own.build("wide")


def test_a_folder_without_the_task_is_one_line(tmp_path):
    with pytest.raises(ValueError, match="right.net.xml is missing; data/intersections/build.py makes it"):
        Intersection("right", folder=FOLDER / "wide")
    shutil.copytree(FOLDER / "wide", tmp_path / "wide")
    (tmp_path / "wide" / "forward.net.xml").write_text("<net/>")
    with pytest.raises(ValueError, match="forward.net.xml is not the file that build.py made"):
        checked(tmp_path / "wide" / "forward.net.xml")
