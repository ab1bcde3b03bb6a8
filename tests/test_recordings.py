"""Recordings hold exactly what was handed in, compare equal when it was equal, and refuse what cannot be drawn."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread
from rerun.chunk import RrdReader

from lifelong_lib.reproduction import recordings
from lifelong_lib.reproduction.files import ReproductionError
from lifelong_lib.reproduction.recordings import Scene, equally_long, save_recording, verify_recording
from lifelong_lib.reproduction.runs import Chapter

STEP = 0.05  # [s]
UNITS = {"pole angle": "rad", "cart position": "m"}
QUARTER_TURN = np.array([0, 0, np.sqrt(0.5), np.sqrt(0.5)])  # about z, as xyzw


def pendulum(angle, colour, **more):
    """A pole of 1 m on a cart; angle: (H+1,) radians from upright."""
    position = 0.1 * np.sin(angle)
    foot = np.stack([position, 0 * angle, 0 * angle], axis=1)
    tip = foot + np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    still, turns = np.tile([0, 0, 0, 1.0], (len(angle), 1)), np.tile(QUARTER_TURN, (len(angle), 1))
    return Scene(colour=colour, parts={"pole": np.stack([foot, tip], axis=1)},
                 boxes={"cart": (foot, (0.1, 0.2, 0.05), still), "turned cart": (foot, (0.1, 0.2, 0.05), turns)},
                 series={"pole angle": angle, "cart position": position}, **more)


def two_scenes(moments=21):
    times = np.arange(moments) * STEP
    rail = {"rail": [(-2, 0, 0), (2, 0, 0)]}
    return {"random": pendulum(0.1 * np.exp(2 * times), "#666666", outcome="falls", fixed=rail),
            "zero-shot": pendulum(0.1 * np.exp(-times), "#0072B2")}


def save(folder, scenes, caption="Watch the pole.", **more):
    chapter = Chapter(4, profile="smoke", seeds=1, output_dir=str(folder))
    return save_recording(chapter, "cart-pole", scenes, STEP, UNITS, caption, **more)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    return save(tmp_path_factory.mktemp("saved"), two_scenes())


def chunks_of(path):
    """{(entity, static): chunk}; a second chunk of the same kind would be a fault of the logging."""
    chunks = list(RrdReader(path).stream())
    found = {(chunk.entity_path, chunk.is_static): chunk for chunk in chunks}
    assert len(found) == len(chunks)
    return found


def exact(path):
    """Every column of a recording but the row ids, which no two recordings share."""
    chunks = chunks_of(path).items()
    return {key: chunk.to_record_batch().drop_columns(["rerun.controls.RowId"]) for key, chunk in chunks}


def rerun_compare(first, second):
    """The exit code of `rerun rrd compare`, which forgives differences in the seventh digit."""
    main = "import sys; from rerun_cli.__main__ import main; sys.exit(main())"
    command = [sys.executable, "-c", main, "rrd", "compare", str(first), str(second)]
    return subprocess.run(command, env=os.environ | {"CI": "1"}, capture_output=True).returncode


def test_recording_holds_exactly_the_expected_entities_and_rows(saved):
    assert saved.name == "cart-pole.rrd" and saved.parent.name == "recordings"
    assert sorted(file.name for file in saved.parent.iterdir()) == ["cart-pole.png", "cart-pole.rrd"]
    moving = {f"/scenes/{title}/{thing}" for title in two_scenes()
              for thing in ("parts/pole", "boxes/cart", "boxes/turned\\ cart")}
    moving |= {f"/series/{series}/{title}" for title in two_scenes() for series in ("pole\\ angle", "cart\\ position")}
    once = moving | {"/caption", "/__properties", "/scenes/random/fixed/rail"}
    rows = {key: chunk.num_rows for key, chunk in chunks_of(saved).items()}
    assert rows == {(entity, True): 1 for entity in once} | {(entity, False): 21 for entity in moving}


def test_values_and_times_come_back_unchanged(saved):
    scenes, chunks = two_scenes(), chunks_of(saved)
    angle = chunks["/series/pole\\ angle/random", False].to_record_batch().to_pydict()
    assert np.array_equal(np.ravel(angle["Scalars:scalars"]), scenes["random"].series["pole angle"])
    assert np.allclose([time.total_seconds() for time in angle["time"]], np.arange(21) * STEP, atol=1e-9)
    pole = chunks["/scenes/zero-shot/parts/pole", False].to_record_batch().to_pydict()["LineStrips3D:strips"]
    assert np.allclose(np.array(pole)[:, 0], scenes["zero-shot"].parts["pole"], atol=1e-6)
    colour = chunks["/scenes/zero-shot/parts/pole", True].to_record_batch().to_pydict()["LineStrips3D:colors"]
    assert colour == [[0x0072B2FF]]
    turned = chunks["/scenes/random/boxes/turned\\ cart", False].to_record_batch().to_pydict()
    assert np.allclose(turned["Boxes3D:quaternions"], QUARTER_TURN, atol=1e-6)


def test_layout_has_a_view_per_scene_and_series_and_travels_in_the_file(saved):
    (blueprint,) = RrdReader(saved).blueprints()
    batches = [chunk.to_record_batch() for chunk in RrdReader(saved).stream(store=blueprint)]
    column = "ViewBlueprint:display_name"
    names = {batch.column(column)[0].as_py()[0] for batch in batches if column in batch.schema.names}
    assert names == {"random: falls", "zero-shot", "pole angle [rad]", "cart position [m]", "cart-pole"}


def test_equal_roll_outs_give_equal_recordings_and_the_same_picture_bytes(saved, tmp_path):
    again = save(tmp_path, two_scenes())
    assert exact(saved) == exact(again)
    assert rerun_compare(saved, again) == 0
    assert saved.with_suffix(".png").read_bytes() == again.with_suffix(".png").read_bytes()


@pytest.mark.parametrize("what", ["value", "last digit", "colour", "caption"])
def test_any_change_makes_recordings_differ(saved, tmp_path, what, monkeypatch):
    monkeypatch.setattr(recordings, "_write_still", lambda path, *_: path.touch())  # not looked at here, and slow
    scenes, caption = two_scenes(), "Watch the pole."
    if what == "value":
        scenes["random"].parts["pole"][7, 1, 2] += 0.01
    if what == "last digit":
        scenes["random"].series["pole angle"][7] += 1e-15
    if what == "colour":
        scenes["random"] = replace(scenes["random"], colour="red")
    if what == "caption":
        caption = "Watch the cart."
    changed = save(tmp_path, scenes, caption)
    assert exact(saved) != exact(changed)
    assert what == "last digit" or rerun_compare(saved, changed) == 1


def test_faces_of_a_turned_box_have_swapped_extents():
    plain, turned = two_scenes()["random"].faces()
    assert np.allclose(np.ptp(plain[3].reshape(-1, 3), axis=0), [0.2, 0.4, 0.1])
    assert np.allclose(np.ptp(turned[3].reshape(-1, 3), axis=0), [0.4, 0.2, 0.1])
    for face in plain[0]:  # its corners are in an order that goes round: each edge is at right angles to the next
        edges = np.roll(face, -1, axis=0) - face
        assert np.allclose(np.sum(edges * np.roll(edges, -1, axis=0), axis=1), 0)


def test_views_show_all_that_moves_but_do_not_follow_a_runaway():
    points = np.zeros((3, 2, 2))
    points[:, 1] = 1.0  # a body of size 1 ...
    points[1] += 0.5
    assert np.array_equal(recordings._window(points), [[0, 0], [1.5, 1.5]])
    points[2] += 1000.0  # ... that leaves
    assert np.array_equal(recordings._window(points), [[0, 0], [3, 3]])


def test_what_starts_as_a_point_or_stays_one_is_shown_too(tmp_path):
    points = np.arange(3.0)[:, None, None] * np.ones((3, 2, 2))
    assert np.array_equal(recordings._window(points), [[0, 0], [2, 2]])
    pin = np.tile([[0.0, 0, 0], [0, 1, 0]], (21, 1, 1))  # seen from its end
    save(tmp_path, {"pin": replace(two_scenes()["random"], parts={"pin": pin}, boxes={})})


def test_still_picture_draws_the_fall_wider_than_the_stand(saved):
    picture = imread(saved.with_suffix(".png"))[:, :, :3]
    upper = picture[40: picture.shape[0] // 2]
    half = upper.shape[1] // 2
    dark = [np.any(side.min(axis=2) < 0.7, axis=0)[20:-20].sum() for side in (upper[:, :half], upper[:, half:])]
    assert dark[0] > 2 * dark[1] > 0, "pixel columns with something dark in them, falling against standing"


def test_nothing_changes_when_writing_fails_halfway(tmp_path, monkeypatch):
    path = save(tmp_path, two_scenes())
    before = path.read_bytes()

    def full_disk(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(recordings, "_write_still", full_disk)
    with pytest.raises(ReproductionError, match="cannot write .*No space left"):
        save(tmp_path, two_scenes(moments=5))
    assert path.read_bytes() == before and len(list(path.parent.iterdir())) == 2


def test_unwritable_folder_is_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ReproductionError, match="cannot write .*file/recordings/cart-pole.rrd"):
        save(tmp_path / "file", two_scenes())


def test_unreadable_files_are_refused(saved, tmp_path):
    verify_recording(saved)
    whole = saved.read_bytes()
    for content in (b"", b"no recording", whole[: len(whole) // 2]):
        (tmp_path / "broken.rrd").write_bytes(content)
        with pytest.raises(ReproductionError, match="broken.rrd cannot be read") as caught:
            verify_recording(tmp_path / "broken.rrd")
        assert "\n" not in str(caught.value)
    with pytest.raises(ReproductionError, match="absent.rrd cannot be read"):
        verify_recording(tmp_path / "absent.rrd")


def test_rerun_is_called_without_usage_statistics(saved, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.delenv("CI", raising=False)
    monkeypatch.setenv("FORCE_RERUN_ANALYTICS", "1")
    verify_recording(saved)
    assert not list(tmp_path.rglob("analytics/*.json"))  # where rerun keeps events until it sends them


def busy(moments=21, **more):
    """A pole that is watched by a crowd of three and sees an image whose brightness tells the moment."""
    angle = np.zeros(moments)
    centres = np.tile([[5.0, 0, 0], [6, 0, 0], [0, -500, 0]], (moments, 1, 1))
    turns = np.tile(QUARTER_TURN, (moments, 3, 1))
    image = np.zeros((moments, 4, 6, 3))
    image[:, 0, 0] = np.linspace(0, 1, moments)[:, None]
    crowd = {"crowd": (centres, (0.2, 0.2, 0.2), turns)}
    return replace(pendulum(angle, "#666666"), **{"crowds": crowd, "images": {"view": image}} | more)


def test_crowds_and_images_are_recorded_whole_and_the_window_is_the_one_asked_for(tmp_path):
    path = save(tmp_path / "a", {"watched": busy(moment=20)}, window=((-7, -1, -1), (7, 1, 2)))
    chunks = chunks_of(path)
    boxes = chunks["/scenes/watched/crowds/crowd", False].to_record_batch().to_pydict()
    assert np.allclose(boxes["Boxes3D:centers"][7], [[5, 0, 0], [6, 0, 0], [0, -500, 0]])
    assert np.shape(chunks["/scenes/watched/crowds/crowd", True].to_record_batch().to_pydict()["Boxes3D:half_sizes"]
                    ) == (1, 3, 3)  # fmt: skip
    (pixels,) = chunks["/images/watched/view", False].to_record_batch().to_pydict()["Image:buffer"][20]
    pixels = np.frombuffer(bytes(pixels), np.uint8).reshape(4, 6, 3)
    assert pixels[3, 0].tolist() == [255] * 3 and pixels.sum() == 3 * 255, "row 0 is below"
    other = save(tmp_path / "b", {"watched": busy(moment=20)})
    assert path.with_suffix(".png").read_bytes() != other.with_suffix(".png").read_bytes()
    again = save(tmp_path / "c", {"watched": busy(moment=20)}, window=((-7, -1, -1), (7, 1, 2)))
    assert exact(path) == exact(again) and rerun_compare(path, again) == 0


def test_every_image_of_a_scene_has_a_place_of_its_own_in_the_still(tmp_path):
    scene = busy(images={"black": np.zeros((21, 4, 6, 3)), "green": np.tile([0.0, 1, 0], (21, 4, 6, 1))})
    picture = imread(save(tmp_path, {"watched": scene}).with_suffix(".png"))[..., :3]
    green = np.all(picture == [0, 1, 0], axis=2)
    black = np.all(picture == 0, axis=2) & green.any(axis=1)[:, None]
    assert black.sum() >= green.sum() > 1000 and green.nonzero()[1].min() > black.nonzero()[1].min()


def test_a_window_replaces_what_moves_and_the_crowd_does_not_widen_the_views():
    points = np.zeros((3, 2, 2))
    assert np.array_equal(recordings._window(points, np.array([[0, 5], [-1, 7]])), [[-1, 5], [0, 7]])
    assert np.abs(busy().points()).max() < 2


def with_part(points):
    return replace(two_scenes()["random"], parts={"pole": points})


STANDING = two_scenes()["random"]
POLE = STANDING.parts["pole"]
CENTRES, _, TURNS = STANDING.boxes["cart"]
BAD_SCENES = {
    "NaN": (with_part(np.where(np.arange(21)[:, None, None] == 17, np.nan, POLE)), "part 'pole': not finite at row 17"),
    "too short": (with_part(POLE[:-1]), r"part 'pole': shape \(20, 2, 3\), wanted \(21, n, 3\)"),
    "flat": (with_part(POLE[:, :, :2]), r"shape \(21, 2, 2\), wanted \(21, n, 3\)"),
    "one point": (with_part(POLE[:, :1]), r"shape \(21, 1, 3\)"),
    "ragged": (with_part([[1, 2], [3]]), "part 'pole': not an array of numbers"),
    "text": (with_part("pole"), "part 'pole': not an array of numbers"),
    "nothing to draw": (replace(STANDING, parts={}, boxes={}), "scene 'odd': give a part or box"),
    "series missing": (replace(STANDING, series={}), r"exactly the series \['pole angle', 'cart position'\]"),
    "half sizes": (replace(STANDING, boxes={"cart": (CENTRES, (1, 1), TURNS)}), "half sizes of box 'cart': shape"),
    "rotations": (replace(STANDING, boxes={"cart": (CENTRES, (1, 1, 1), CENTRES)}), "rotations of box 'cart': shape"),
    "crowd": (replace(busy(), crowds={"crowd": (CENTRES, (1, 1, 1), CENTRES)}), "centres of crowd 'crowd': shape"),
    "crowd's rotations": (replace(busy(), crowds={"crowd": (CENTRES[:, None], (1, 1, 1), np.ones((21, 2, 4)))}),
                          r"rotations of crowd 'crowd': shape \(21, 2, 4\), wanted \(21, 1, 4\)"),
    "image": (replace(busy(), images={"view": np.ones((21, 4, 6))}), "image 'view': shape"),
    "moment": (busy(moment=21), "moment 21 is not one of the 21"),
    "fixed": (replace(STANDING, fixed={"rail": [(0, 0)]}), "fixed 'rail': shape"),
}


@pytest.mark.parametrize("case", BAD_SCENES)
def test_bad_scenes_are_refused_in_one_line_that_names_them(tmp_path, case):
    scene, message = BAD_SCENES[case]
    with pytest.raises(ReproductionError, match=message) as caught:
        save(tmp_path, {"good": two_scenes()["random"], "odd": scene})
    assert "\n" not in str(caught.value) and "scene 'odd'" in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_scenes_of_different_lengths_are_refused(tmp_path):
    with pytest.raises(ReproductionError, match=r"scene 'short', series 'pole angle': shape \(20,\), wanted \(21\)"):
        save(tmp_path, {"long": pendulum(np.zeros(21), "red"), "short": pendulum(np.zeros(20), "blue")})


def test_empty_or_senseless_arguments_are_refused(tmp_path):
    chapter, scenes = Chapter(4, profile="smoke", seeds=1, output_dir=str(tmp_path)), two_scenes()
    for arguments, message in (
        (("a", {}, STEP, UNITS, ""), "at least one scene"),
        (("a", scenes, STEP, {}, ""), "one series"),
        (("a/b", scenes, STEP, UNITS, ""), "recording name 'a/b'"),
        (("a", scenes, 0.0, UNITS, ""), "seconds_per_step is 0.0"),
        (("a", scenes, float("nan"), UNITS, ""), "seconds_per_step is nan"),
        (("a", scenes, STEP, UNITS, "", (0, 0, 1)), r"seen_from is \(0, 0, 1\)"),
        (("a", {"empty": pendulum(np.zeros(0), "red")}, STEP, UNITS, ""), r"shape \(0,\)"),
    ):
        with pytest.raises(ReproductionError, match=message):
            save_recording(chapter, *arguments)


def test_shorter_scenes_hold_their_last_moment():
    boxes = {"car": (np.arange(9.0).reshape(3, 3), (1, 1, 1), np.tile(QUARTER_TURN, (3, 1)))}
    crowds = {"cars": (np.arange(18.0).reshape(3, 2, 3), (1, 1, 1), np.tile(QUARTER_TURN, (3, 2, 1)))}
    images = {"input": np.linspace(0, 1, 3)[:, None, None, None] * np.ones((4, 5, 3))}
    short = Scene("#000000", {"line": np.ones((3, 2, 3))}, boxes, {"x": np.arange(3)}, crowds=crowds, images=images,
                  outcome="ends", moment=1)  # fmt: skip
    long = Scene("#000000", {"line": np.ones((5, 2, 3))}, {}, {"x": np.arange(5)})
    made = equally_long({"short": short, "long": long})
    held = made["short"]
    assert held.series["x"].tolist() == [0, 1, 2, 2, 2] and held.parts["line"].shape == (5, 2, 3)
    assert held.boxes["car"][0][:, 0].tolist() == [0, 3, 6, 6, 6] and held.boxes["car"][2].shape == (5, 4)
    assert held.crowds["cars"][0][:, 1, 2].tolist() == [5, 11, 17, 17, 17]
    assert held.crowds["cars"][2].shape == (5, 2, 4) and held.images["input"][3:, 0, 0, 0].tolist() == [1, 1]
    assert (held.outcome, held.moment) == ("ends", 1)
    assert made["long"].series["x"].tolist() == [0, 1, 2, 3, 4]
    with pytest.raises(ReproductionError, match="scenes of any length need a series each"):
        equally_long({"none": Scene("#000000", {"line": np.ones((3, 2, 3))})})
