"""Recorded junctions: reading them, trials along them, and the stand-in of data/recordings."""

import importlib.util
import subprocess
import sys
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from conftest import REPOSITORY, trial
from gymnasium.utils.env_checker import check_env

from lifelong_lib.environments import recorded_traffic
from lifelong_lib.environments.crossing import COLUMN, GO, LENGTH, ROW, SPEED
from lifelong_lib.environments.pictures import OTHER, OWN
from lifelong_lib.environments.recorded_traffic import RecordedTraffic, Recording, is_safe, read_recording

FOLDER = REPOSITORY / "data" / "recordings"

# Four frames at 10 Hz. The car waits at (100, 200) and looks along x: forwards is x - 100, right is 200 - y.
FILES = {
    "recordingMeta": """recordingId,locationId,frameRate,speedLimit,weekday,startTime,duration,numTracks,numVehicles
7,0,10,15.6,none,0,0.4,3,2
""",
    "tracksMeta": """recordingId,trackId,initialFrame,finalFrame,numFrames,width,length,class
7,4,0,2,3,1.8,4.6,car
7,5,1,1,1,0.5,0.5,pedestrian
7,6,2,3,2,2.5,9.1,truck_bus
""",
    "tracks": """recordingId,trackId,frame,trackLifetime,xCenter,yCenter,heading,width,length,xVelocity,yVelocity
7,4,0,0,105,210,270,1.8,4.6,0,-10
7,4,1,1,105,209,270,1.8,4.6,0,-10
7,4,2,2,105,208,270,1.8,4.6,0,-10
7,5,1,0,101,201,0,0.5,0.5,1,0
7,6,2,0,112,190,90,2.5,9.1,3,4
7,6,3,1,112,191,90,2.5,9.1,3,4
""",
    "labels": "frame,go\n0,0\n1,1\n2,0\n3,1\n",
    "ego": "xCenter,yCenter,heading\n100,200,0\n",
}
CAR = [[-10, 5, 2 * np.pi, 10], [-9, 5, 2 * np.pi, 10], [-8, 5, 2 * np.pi, 10]]
TRUCK = [[10, 12, np.pi, 5], [9, 12, np.pi, 5]]
FRAMES = [[CAR[0]], [CAR[1]], [CAR[2], TRUCK[0]], [TRUCK[1]]]


@pytest.fixture
def read(tmp_path):
    """Writes files as recording 7 and reads it."""

    def write_and_read(files):
        for part, text in files.items():
            (tmp_path / f"07_{part}.csv").write_text(text)
        return read_recording(7, tmp_path)

    return write_and_read


def assert_expected(recording):
    assert recording.frame_rate == 10 and recording.duration == 0.4
    for cars, due in zip(recording.cars, FRAMES, strict=True):
        np.testing.assert_allclose(cars, due, atol=1e-9)
    for track, due in zip(recording.tracks, (CAR, TRUCK), strict=True):
        np.testing.assert_allclose(track, np.array(due)[:, :2], atol=1e-9)
    assert recording.labels.tolist() == [False, True, False, True]


# ------------------------------------------------------------------------------------------------------------- reading

def test_a_recording_is_read_as_the_waiting_car_sees_it(read):
    assert_expected(read(FILES))


def test_columns_of_public_sets_and_their_line_ends_are_passed_over(read):
    wide = {part: text.replace("\n", ",x\r\n").replace(",x\r", ",lonVelocity\r", 1) for part, text in FILES.items()}
    wide["labels"] = "\ufeff" + wide["labels"]  # as some spreadsheets begin a file
    assert_expected(read(wide))
    narrow = {"tracks": "\n".join(",".join(line.split(",")[1:]) for line in FILES["tracks"].splitlines())}
    assert_expected(read(FILES | narrow))


def test_the_frame_of_the_recording_does_not_matter(read):
    angle = np.deg2rad(37)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = {}
    for part in ("tracks", "ego"):
        header, *rows = (line.split(",") for line in FILES[part].splitlines())
        for row in rows:
            value = dict(zip(header, map(float, row), strict=True))
            value["xCenter"], value["yCenter"] = turn @ [value["xCenter"], value["yCenter"]] + [5000, -300]
            value["heading"] = (value["heading"] + 37) % 360
            if part == "tracks":
                value["xVelocity"], value["yVelocity"] = turn @ [value["xVelocity"], value["yVelocity"]]
            row[:] = [repr(float(value[column])) for column in header]
        moved[part] = "\n".join(map(",".join, [header, *rows]))
    recording = read(FILES | moved)
    wrapped = [np.column_stack([cars[:, :2], cars[:, 2] % (2 * np.pi), cars[:, 3]]) for cars in recording.cars]
    for cars, due in zip(wrapped, FRAMES, strict=True):
        np.testing.assert_allclose(cars[:, [0, 1, 3]], np.array(due)[:, [0, 1, 3]], atol=1e-9)
        np.testing.assert_allclose(np.cos(cars[:, 2]), np.cos(np.array(due)[:, 2]), atol=1e-9)


def test_a_recording_may_end_with_nobody_in_sight_and_its_duration_may_be_rounded(read):
    files = {part: text for part, text in FILES.items() if part != "labels"}
    longer = read(files | {"recordingMeta": FILES["recordingMeta"].replace(",0.4,", ",0.6,")})
    assert len(longer.labels) == 6 and [len(cars) for cars in longer.cars] == [1, 1, 2, 1, 0, 0]
    assert len(read(files | {"recordingMeta": FILES["recordingMeta"].replace(",0.4,", ",0.34,")}).labels) == 4
    empty = read(files | {"tracksMeta": FILES["tracksMeta"].replace("car", "bicycle").replace("truck_bus", "bicycle")})
    assert [len(cars) for cars in empty.cars] == [0, 0, 0, 0] and empty.labels.all() and empty.tracks == []


def test_without_labels_the_rule_gives_them(read, tmp_path):
    recording = read({part: text for part, text in FILES.items() if part != "labels"})
    # The car is 10.3, 9.3, 8.4 m from the point in front and comes at 10 m/s; the truck, 11.0 and 10.1 m, at 5 m/s.
    assert recording.labels.tolist() == [False] * 4
    assert is_safe(np.zeros((0, 4)))
    for x, heading, speed, safe in (
        (-56.1, 0, 10, True), (-56, 0, 10, False),  # 50 m in 5 s up to a circle of 6 m
        (56.1, np.pi, 10, True), (56, np.pi, 10, False),
        (-20, np.pi, 10, True), (20, 0, 10, True),  # drive away
        (6.1, 0, 10, True), (6, 0, 10, False),  # has just left; has not
        (-6.1, 0, 0, True), (-6, 0, 0, False),  # stands
    ):  # fmt: skip
        assert is_safe(np.array([[x, 7.5, heading, speed]])) == safe, (x, heading, speed)
    assert not is_safe(np.array([[20, 7.5, 0, 10], [-20, 7.5, 0, 10]]))


# ----------------------------------------------------------------------------------------------------------- bad input

BAD = (  # file, what stands in it, what is written there instead, message
    ("recordingMeta", None, None, r"07_recordingMeta.csv is missing"),
    ("tracksMeta", None, None, r"07_tracksMeta.csv is missing"),
    ("tracks", None, None, r"07_tracks.csv is missing"),
    ("ego", None, None, r"07_ego.csv is missing"),
    ("tracks", FILES["tracks"], "", r"07_tracks.csv has no rows"),
    ("labels", FILES["labels"], "frame,go\n", r"07_labels.csv has no rows"),
    ("tracks", "heading", "yaw", r"07_tracks.csv, row 1: there is no column heading"),
    ("recordingMeta", "frameRate", "rate", r"07_recordingMeta.csv, row 1: there is no column frameRate"),
    ("ego", "xCenter", "x", r"07_ego.csv, row 1: there is no column xCenter"),
    ("labels", "go", "safe", r"07_labels.csv, row 1: there is no column go"),
    ("tracks", "191,90,2.5,9.1,3,4\n", "19", r"07_tracks.csv, row 7: 6 values for 11 columns"),
    ("tracks", "105,209", "105,2x9", r"07_tracks.csv, row 3, column yCenter: '2x9' is not a finite number"),
    ("tracks", "105,209", "inf,209", r"07_tracks.csv, row 3, column xCenter: 'inf' is not a finite number"),
    ("tracks", "105,209,270", "105,209,nan", r"07_tracks.csv, row 3, column heading: 'nan' is not a finite number"),
    ("ego", "200", "", r"07_ego.csv, row 2, column yCenter: '' is not a finite number"),
    ("tracks", "7,4,1,", "7,4,1.5,", r"07_tracks.csv, row 3, column frame: '1.5' is not a whole number from 0 on"),
    ("tracks", "7,4,0,", "7,4,-1,", r"07_tracks.csv, row 2, column frame: '-1' is not a whole number from 0 on"),
    ("tracksMeta", "7,4,0,", "7,4,1e99,", r"row 2, column initialFrame: '1e99' is not a whole number from 0 on"),
    ("tracks", "7,4,1,", "7,4,3,", r"07_tracks.csv, row 4, column frame: '2' does not come after the frame before"),
    ("tracks", "7,4,2,", "7,4,1,", r"07_tracks.csv, row 4, column frame: '1' does not come after the frame before"),
    ("tracks", "7,5,1,", "7,9,1,", r"07_tracks.csv, row 5, column trackId: '9' is not in 07_tracksMeta.csv"),
    ("tracks", "7,6,3,1,112,191,90,2.5,9.1,3,4\n", "",
     r"07_tracksMeta.csv, row 4, column finalFrame: '3' is not what the track has in 07_tracks.csv"),
    ("tracksMeta", "7,5,1,1,1", "7,8,1,1,0", r"07_tracks.csv, row 5, column trackId: '5' is not in 07_tracksMeta.csv"),
    ("tracksMeta", "7,6,2,3,2,", "7,6,2,3,2,2.5,9.1,car\n7,8,2,2,0,",
     r"07_tracksMeta.csv, row 5, column numFrames: '0' is not how many rows the track has"),
    ("tracksMeta", "7,6,2,3,2", "7,6,2,4,2",
     r"07_tracksMeta.csv, row 4, column finalFrame: '4' is not what the track has in 07_tracks.csv"),
    ("tracksMeta", "7,6,2,3,2", "7,6,3,4,2",
     r"07_tracksMeta.csv, row 4, column initialFrame: '3' is not what the track has in 07_tracks.csv"),
    ("tracksMeta", "7,6,2,3,2", "7,6,2,3,5", r"row 4, column numFrames: '5' is not how many rows the track has"),
    ("tracksMeta", "7,6,2", "7,4,2", r"07_tracks.csv, row 6, column trackId: '6' is not in 07_tracksMeta.csv"),
    ("tracksMeta", "7,5,1,1,1", "7,4,0,2,3", r"07_tracks.csv, row 5, column trackId: '5' is not in"),
    ("tracksMeta", ",car", ",motor",
     r"row 2, column class: 'motor' is no class known here: seen are car, van, .*, and not seen bicycle, pedestrian"),
    ("tracks", "xCenter,yCenter,heading", "x,y,psi_rad", r"no column xCenter; this looks like INTERACTION's layout"),
    ("tracks", "heading", "precedingId", r"no column heading; this looks like highD's layout, which has no headings"),
    ("recordingMeta", ",10,", ",0,", r"07_recordingMeta.csv, row 2, column frameRate: '0.0' is not above 0"),
    ("recordingMeta", ",10,", ",-25,", r"07_recordingMeta.csv, row 2, column frameRate: '-25.0' is not above 0"),
    ("recordingMeta", ",0.4,", ",0.01,", r"row 2, column duration: '0.01' is not the time of any number of frames"),
    ("recordingMeta", ",0.4,", ",1e300,", r"row 2, column duration: '1e\+300' is not the time of any number of frames"),
    ("labels", "1,1", "1,2", r"07_labels.csv, row 3, column go: '2' is neither 0 nor 1"),
    ("labels", "1,1", "1,yes", r"07_labels.csv, row 3, column go: 'yes' is not a whole number from 0 on"),
    ("labels", "2,0\n", "", r"07_labels.csv, row 4, column frame: '3' is not the frame that is due"),
    ("labels", "3,1\n", "", r"07_labels.csv, column frame: there are 3 rows for 4 frames"),
    ("labels", "3,1\n", "3,1\n4,1\n", r"07_labels.csv, column frame: there are 5 rows for 4 frames"),
)  # fmt: skip


@pytest.mark.parametrize(("part", "old", "new", "message"), BAD)
def test_bad_files_are_one_clear_line(part, old, new, message, read):
    files = dict(FILES)
    if old is None:
        del files[part]
    else:
        assert old in files[part]
        files[part] = files[part].replace(old, new, 1)
    with pytest.raises(ValueError, match=message) as caught:
        read(files)
    assert "\n" not in str(caught.value)


def test_binary_files_are_refused_like_others(read, tmp_path):
    read(FILES)
    for content in (bytes(range(256)) * 100, b"\x00" * 999, FILES["tracks"].encode() + bytes(range(256))):
        (tmp_path / "07_tracks.csv").write_bytes(content)
        with pytest.raises(ValueError, match=r"07_tracks.csv") as caught:
            read_recording(7, tmp_path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("turned", "cause"), [
    (lambda degrees: np.deg2rad(degrees), "they agree if they are in radians"),
    (lambda degrees: 90 - degrees, "they agree if they are bearings from north"),
    (lambda degrees: -degrees, "they agree if its y axis points down"),
    (lambda degrees: degrees + 180, "they agree if they point backwards"),
    (lambda degrees: degrees + 70, "one of the two is wrong"),
])  # fmt: skip
def test_headings_that_velocities_speak_against_are_refused_with_the_likely_cause(read, turned, cause):
    header, *rows = (line.split(",") for line in FILES["tracks"].splitlines())
    for row, (vx, vy) in zip(rows, 3 * [(5, 9)] + [(1, 0)] + 2 * [(-9, 2)], strict=True):
        row[9:11], row[6] = map(str, (vx, vy)), repr(float(turned(np.rad2deg(np.arctan2(vy, vx)))))
    with pytest.raises(ValueError, match=f"07_tracks.csv, column heading: headings and velocities are .*; {cause}"):
        read(FILES | {"tracks": "\n".join(map(",".join, [header, *rows]))})
    standing = "\n".join(",".join([*row[:9], "0.5", "0.5"]) if row is not header else ",".join(row)
                         for row in [header, *rows])  # fmt: skip
    read(FILES | {"tracks": standing})  # who stands shivers


def test_real_files_habits_are_passed_over(read):
    about = FILES["tracksMeta"].replace("trackId", '"TrackID"').replace(",class", ", Class ")
    about = about.replace("car", '"Car"').replace("truck_bus", "Truck-Bus")
    tracks = FILES["tracks"].replace("105,209", '"105", 209 ').replace("heading", "Heading") + "\n\n"
    assert_expected(read(FILES | {"tracksMeta": about + "\n", "tracks": tracks}))
    quoted = FILES["tracks"].replace("xVelocity", '"note, quoted",xVelocity').replace("9.1,3", '9.1,"a, b",3')
    quoted = quoted.replace("4.6,0", '4.6,"a, b",0').replace("0.5,1,", '0.5,x,1,')
    assert_expected(read(FILES | {"tracks": quoted}))


def test_frames_missing_inside_a_track_are_filled_evenly(read):
    row = "7,4,1,1,105,209,270,1.8,4.6,0,-10\n"
    assert row in FILES["tracks"]
    assert_expected(read(FILES | {"tracks": FILES["tracks"].replace(row, "")}))
    fewer = FILES["tracksMeta"].replace("7,4,0,2,3", "7,4,0,2,2")  # some count the rows, others the frames
    assert_expected(read(FILES | {"tracks": FILES["tracks"].replace(row, ""), "tracksMeta": fewer}))


def test_headings_are_filled_the_short_way_round():
    filled = recorded_traffic._filled(np.array([3, 5]), np.array([[0, 0, 6.2, 4], [2, 4, 0.1, 6]]))
    assert filled == pytest.approx(np.array([[0, 0, 6.2, 4], [1, 2, (6.2 + 0.1 + 2 * np.pi) / 2, 5],
                                             [2, 4, 0.1 + 2 * np.pi, 6]]))  # fmt: skip


# -------------------------------------------------------------------------------------------------------------- trials

def film(rate, frames, labels=True):
    """A recording in which one car stands in front, with a speed that tells the frame."""
    cars = [np.array([[0.1, 5.0, 0.0, frame / 100]]) for frame in range(frames)]
    return Recording(rate, cars, np.full(frames, labels) if np.isscalar(labels) else labels, [])


def frame_of(image):
    return round(float(image[:, :, 1].max()) * SPEED * 100)


def test_gymnasium_finds_nothing_to_complain_of():
    env = gym.make("lifelong_lib/RecordedTraffic-v0", recording=read_recording(0, FOLDER))
    check_env(env.unwrapped)


@pytest.mark.parametrize(("rate", "windows"), [
    (25, {0: range(0, 5), 1: range(5, 10), 2: range(10, 15), 4: range(20, 25), 8: range(40, 45), 100: range(500, 505)}),
    (10, {0: range(0, 2), 1: range(2, 4), 2: range(4, 6), 4: range(8, 10), 8: range(16, 18), 100: range(200, 202)}),
    (12, {0: range(0, 2), 1: range(2, 4), 2: range(4, 7), 4: range(9, 12), 8: range(19, 21), 100: range(240, 242)}),
    (5, {0: range(0, 1), 1: range(1, 2), 2: range(2, 3), 4: range(4, 5), 8: range(8, 9), 100: range(100, 101)}),
])  # fmt: skip
def test_what_is_seen_is_any_frame_of_the_step_and_no_other(rate, windows):
    env = RecordedTraffic(film(rate, windows[100].stop))  # just long enough: trials begin with the first frame
    seen = {step: set() for step in windows}
    for seed in range(100):
        for action, took in enumerate((1, 2, 4, 8)):
            images = [step[0] for step in trial(env, seed, [action])]
            seen[0].add(frame_of(images[0]))
            seen[took].add(frame_of(images[1]))
        seen[100].add(frame_of(trial(env, seed, [3] * 13)[-1][0]))
    assert seen == {step: set(window) for step, window in windows.items()}


def test_trials_begin_wherever_20_seconds_are_left():
    env = RecordedTraffic(film(10, 202 + 5))
    starts, ends = set(), set()
    for seed in range(300):
        steps = trial(env, seed, [3] * 13)
        starts.add(frame_of(steps[0][0]))
        ends.add(frame_of(steps[-1][0]))
    assert starts == set(range(0, 7)) and ends == set(range(200, 207))


def test_the_label_of_the_seen_frame_decides():
    for safe, outcome, reward in ((True, "success", 0.99), (False, "collision", -1.01)):
        env = RecordedTraffic(film(25, 600, safe))
        for seed in range(20):
            *_, (_, got, terminated, truncated, info) = trial(env, seed, [2, GO])
            assert (got, terminated, truncated) == (pytest.approx(reward), True, False)
            assert info == {"steps": 1, "outcome": outcome}
    labels, outcomes = np.random.default_rng(0).random(600) < 0.5, set()
    env = RecordedTraffic(film(25, 600, labels))
    for seed in range(200):
        *_, (image, *_), (*_, info) = trial(env, seed, [1, GO])
        outcomes.add(info["outcome"])
        assert info["outcome"] == ("success" if labels[frame_of(image)] else "collision")
    assert outcomes == {"success", "collision"}


def test_waiting_ends_after_20_seconds_with_the_discounted_cost_of_every_step():
    env = RecordedTraffic(film(25, 505))
    seen = trial(env, 0, [3] * 20)[1:]
    assert [step[4]["steps"] for step in seen] == [8] * 12 + [4]
    for _, reward, _, _, info in seen:
        assert reward == pytest.approx(-0.01 * (1 - 0.99 ** info["steps"]) / 0.01)
    assert [step[4]["outcome"] for step in seen] == [""] * 12 + ["timeout"]
    assert [step[3] for step in seen] == [False] * 12 + [True] and not any(step[2] for step in seen)
    last = trial(env, 0, [0] * 99 + [GO])[-1]  # with the last step one may still go
    assert last[2] and not last[3] and last[4] == {"steps": 1, "outcome": "success"}


def test_the_same_seed_is_the_same_trial_and_another_is_another():
    def images(env, seed):
        return [step[0].tobytes() for step in trial(env, seed, [0, 3, 1, 2, GO])]

    recording = read_recording(0, FOLDER)
    one, other = RecordedTraffic(recording), RecordedTraffic(read_recording(0, FOLDER))
    first = images(one, 3)
    assert images(one, 4) != first
    assert images(one, 3) == first == images(other, 3)


def test_a_car_is_in_the_row_that_counts_from_the_line():
    recording = Recording(10, [np.array([[COLUMN / 2, 1.5 * ROW, 0.0, SPEED]])] * 202, np.full(202, True), [])
    image, info = RecordedTraffic(recording).reset(seed=0)
    assert np.argwhere(image[:, :, 2]).tolist() == [[3 + 1, 13]] and image[4, 13].tolist() == [1, 1, 1]
    assert info == {"steps": 0, "outcome": ""}


def test_the_picture_shows_the_frame_that_is_seen():
    recording = read_recording(0, FOLDER)
    env = RecordedTraffic(recording, render_mode="rgb_array")
    env.reset(seed=0)
    own, others = env.cars()
    assert own.tolist() == [[0, -LENGTH / 2, np.pi / 2, 0]] and others is recording.cars[env.frame]
    blue, orange = (np.argwhere((env.render() == colour).all(axis=2)) for colour in (OTHER, OWN))
    assert len(blue) > 0 and 150 < len(orange) < 5 * 1.8 * 25  # what is not at its edge of a car of 5 m x 1.8 m
    shown = (np.abs(others[:, 0]) < 97) & (others[:, 1] > -9) & (others[:, 1] < 45)
    for x, y, *_ in others[shown]:
        assert (np.hypot(blue[:, 1] / 5 - 100 - x, 48 - blue[:, 0] / 5 - y) < 0.3).any()


def test_a_recording_that_is_too_short_is_refused_and_a_trial_that_has_ended_not_stepped():
    with pytest.raises(ValueError, match="the recording has 504 frames; a trial of 100 steps needs 505"):
        RecordedTraffic(film(25, 504))
    with pytest.raises(ValueError, match=r"4 frames a second are not one in every step of 0.2 s"):
        RecordedTraffic(film(4, 1000))
    env = RecordedTraffic(film(25, 505))
    with pytest.raises(RuntimeError, match="the trial has ended, or was never begun: reset the environment first"):
        env.step(0)
    for actions in ([GO], [3] * 13):
        trial(env, 0, actions)
        with pytest.raises(RuntimeError, match="the trial has ended"):
            env.step(0)


# ------------------------------------------------------------------------------------------------------- the stand-in

each_recording = pytest.mark.parametrize("number", (0, 1))


@pytest.fixture(scope="module")
def make():
    """The script of data/recordings as a module."""
    spec = importlib.util.spec_from_file_location("make_recordings", FOLDER / "make.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@each_recording
def test_the_stand_in_is_a_minute_in_which_about_20_cars_drive_past(number):
    recording = read_recording(number)
    assert recording.duration == 60 and recording.frame_rate == 25
    passed = sum(track[0, 0] * track[-1, 0] < 0 for track in recording.tracks)
    assert 17 <= passed <= 24
    assert 0.15 < recording.labels.mean() < 0.7
    cars = np.concatenate(recording.cars)
    assert np.hypot(*cars[:, :2].T).max() < 118 and 8 < cars[:, 3].min() and cars[:, 3].max() < 22
    # In front the near lane, to the right, has its middle 4.8 m from the line; the far lane 5.6 m more.
    front = cars[np.abs(cars[:, 0]) < 8]
    right = np.cos(front[:, 2]) > 0
    assert front[right, 1].mean() == pytest.approx(4.8, abs=0.4)
    assert front[~right, 1].mean() == pytest.approx(10.4, abs=0.4)


@each_recording
def test_who_knows_the_labels_always_succeeds_and_who_goes_blindly_does_not(number):
    recording, outcomes = read_recording(number), []
    env = RecordedTraffic(recording)
    for seed in range(100):
        env.reset(seed=seed)
        info = {"outcome": ""}
        while not info["outcome"]:
            *_, info = env.step(GO if recording.labels[env.frame] else 0)
        outcomes.append(info["outcome"])
    assert set(outcomes) == {"success"}
    assert {trial(env, seed, [GO])[-1][4]["outcome"] for seed in range(50)} == {"success", "collision"}


def test_the_script_makes_the_committed_files(tmp_path):
    subprocess.run([sys.executable, FOLDER / "make.py", tmp_path], check=True)
    committed = {file.name: file.read_bytes() for file in FOLDER.glob("*.csv")}
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == committed
    assert len(committed) == 10 and sum(map(len, committed.values())) < 900_000


def test_cars_follow_each_other_without_touching_and_come_as_often_as_they_should(make):
    assert make.gipps(15.0, 15.0, 1.7, np.inf, 0.0) == 15.0  # as fast as wished
    assert make.gipps(0.0, 15.0, 1.7, 0.0, 0.0) == 0.0  # no room
    assert make.gipps(15.0, 20.0, 1.7, 5.0, 10.0) < 15.0 < make.gipps(15.0, 20.0, 1.7, 500.0, 10.0)
    cars = make.drive(np.random.default_rng(0), 600)
    assert len(cars) == pytest.approx(630 / 6, abs=3 * np.sqrt(630 / 6))
    for leader, follower in zip(cars, cars[1:], strict=False):
        room = leader["along"] - follower["along"] - (leader["length"] + follower["length"]) / 2
        assert not (room < 2).any()
    for car in cars:  # speeds are those of the positions
        moved, there = np.diff(car["along"]) * make.RATE, ~np.isnan(car["along"][:-1])
        assert np.allclose(moved[there], ((car["speed"][1:] + car["speed"][:-1]) / 2)[there], atol=0.01)


def test_the_observer_looks_ahead_and_is_late(make, monkeypatch):
    monkeypatch.setattr(make, "MISJUDGED", 0)
    rng = np.random.default_rng(0)
    along = np.array([-42.1, -41.9, -3.1, -2.9, np.nan])
    car = {"along": along, "length": 4.0, "speed": np.full(5, 10.0)}  # its front is 2 m ahead, its rear 2 m behind
    assert make.blocks(rng, car, 0.5, 4.0).tolist() == [False, True, True, False, False]
    monkeypatch.setattr(make, "LAG_SPREAD", 0)
    safe = np.repeat([False, True, False], [10, 20, 30])
    assert make.says(rng, safe).tolist() == np.repeat([False, True, False], [18, 20, 22]).tolist()
    assert make.wander(rng, 100_000, 0.3, 1.0).std() == pytest.approx(0.3, rel=0.05)


def test_rows_can_be_counted_from_the_middle_of_the_main_road_if_that_is_known():
    recording = read_recording(0)
    assert recording.middle == pytest.approx(7.6 / np.sin(np.deg2rad(84)), abs=0.01)  # data/recordings/README.md
    one, other = (RecordedTraffic(recording, coordinates) for coordinates in ("local", "global"))
    one.reset(seed=0)
    other.reset(seed=0)
    cars = one.cars()[1]
    assert np.array_equal(cars, other.cars()[1])
    assert one.origin[1] == pytest.approx(-3 * ROW) and other.origin[1] == pytest.approx(recording.middle - 9 * ROW)
    near = RecordedTraffic(replace(recording, cars=[np.array([[0, recording.middle - 1.8, 0, 10.0]])] * 1500), "global")
    assert near.reset(seed=0)[0][8, :, 2].sum() == 1  # the nearer lane is the row below the middle
    with pytest.raises(ValueError, match="need the main road's middle: add the column toMiddle to the ego file"):
        RecordedTraffic(replace(recording, middle=None), "global")
    with pytest.raises(ValueError, match="no 'polar' coordinates; there are local and global"):
        RecordedTraffic(recording, "polar")
