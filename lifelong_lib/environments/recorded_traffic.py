"""A recorded junction: the car waits along the recording and chooses when to go (thesis section 5.5.1).

The files are laid out as the public drone recordings (inD, rounD); data/recordings describes them and holds a stand-in
for the thesis's recording, which is not public. Registered as lifelong_lib/RecordedTraffic-v0.
"""

from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np

from lifelong_lib.environments.crossing import (
    GO,
    LENGTH,
    MAX_STEPS,
    ROW,
    ROWS,
    ROWS_BEHIND,
    STEP_SECONDS,
    WAITS,
    WIDTH,
    Crossing,
)

FOLDER = Path(__file__).resolve().parents[2] / "data" / "recordings"
VEHICLES = ("car", "van", "truck", "bus", "truck_bus", "trailer", "motorcycle")  # all that the car sees
WHOLE = ("trackId", "frame", "initialFrame", "finalFrame", "numFrames", "go")  # columns of whole numbers from 0 on
AHEAD, AREA, SOON = 7.5, 6.0, 5.0  # [m], [m], [s] of the rule `is_safe`


@dataclass(frozen=True, eq=False)
class Recording:
    """What passed a waiting car, as seen from the middle of its front: x to the right, y forwards."""

    frame_rate: float  # [1/s]
    cars: list[np.ndarray]  # for each frame (n, 4): x, y [m], heading [rad] from the x axis to the left, speed [m/s]
    labels: np.ndarray  # (frames,) bool: whether going is safe
    tracks: list[np.ndarray]  # for each vehicle's track (n, 2): x, y [m]; to draw a map
    middle: float | None = None  # [m] straight ahead to the middle of the main road, if that is known

    @property
    def duration(self) -> float:
        """Seconds."""
        return len(self.labels) / self.frame_rate


class RecordedTraffic(Crossing):
    """A trial along the recording: wait 1, 2, 4 or 8 steps, or go, which ends it as the label of the seen frame says.

    A trial begins at any frame that 20.2 s of recording follow. A step is 0.2 s; what is seen is one of the frames in
    it, drawn anew, so that a short recording gives many trials. Nobody reacts to what the car does.
    All else is as in `Crossing`, with ``coordinates`` as in `Intersection`, but going takes one step. Raises ValueError
    for a recording that is too short, has not a frame in every step or does not say where its main road's middle is.
    """

    def __init__(self, recording: Recording, coordinates: str = "local", discount: float = 0.99,
                 render_mode: str | None = None):  # fmt: skip
        super().__init__(discount, render_mode)
        if coordinates not in ("local", "global"):
            raise ValueError(f"no {coordinates!r} coordinates; there are local and global")
        if coordinates == "global" and recording.middle is None:
            raise ValueError("global coordinates need the main road's middle: add the column toMiddle to the ego file")
        lowest = -ROWS_BEHIND * ROW if coordinates == "local" else recording.middle - ROWS / 2 * ROW
        self.origin = np.array([0, lowest])
        self._window = STEP_SECONDS * recording.frame_rate  # frames in a step, not always a whole number
        frames, needed = len(recording.labels), int((MAX_STEPS + 1) * self._window)  # one look after the last step
        if self._window < 1:
            raise ValueError(f"{recording.frame_rate:g} frames a second are not one in every step of {STEP_SECONDS} s")
        if frames < needed:
            raise ValueError(f"the recording has {frames} frames; a trial of {MAX_STEPS} steps needs {needed}")
        self.recording, self._starts = recording, frames - needed + 1

    def cars(self) -> tuple[np.ndarray, np.ndarray]:
        """Poses of the own car (1, 4), which stays at its line, and of those in the frame that was seen last (n, 4)."""
        return np.array([[0, -LENGTH / 2, np.pi / 2, 0]]), self.recording.cars[self.frame]

    def _begin(self, seeded):
        self._start = int(self.np_random.integers(self._starts))

    def _act(self, action):
        took = 1 if action == GO else min(WAITS[action], MAX_STEPS - self.steps)
        self.steps += took
        if action != GO:
            return ""
        return "success" if self.recording.labels[self.frame] else "collision"

    def _look(self):
        first, end = (self._start + int(step * self._window) for step in (self.steps, self.steps + 1))
        self.frame = int(self.np_random.integers(first, end))
        return super()._look()

    def _ground(self):
        second = max(1, round(self.recording.frame_rate))
        return [track[::second] for track in self.recording.tracks], WIDTH  # what cars have driven over


gym.register("lifelong_lib/RecordedTraffic-v0", f"{__name__}:RecordedTraffic")


def is_safe(cars: np.ndarray) -> bool:
    """The label of a frame that nobody labelled: whether none of ``cars`` (n, 4) is in the way or will be soon.

    In the way is a circle of radius AREA about the point AHEAD of the waiting car's front. A car will be there soon if
    it comes nearer and its speed takes it as far as the circle within SOON, however the road bends.
    """
    offset = np.array([0, AHEAD]) - cars[:, :2]
    comes = offset[:, 0] * np.cos(cars[:, 2]) + offset[:, 1] * np.sin(cars[:, 2]) > 0
    return not (np.hypot(*offset.T) <= AREA + comes * cars[:, 3] * SOON).any()


def read_recording(number: int, folder: Path = FOLDER) -> Recording:
    """Read recording ``number`` of a folder, with its own labels or, where there are none, those of `is_safe`.

    Raises ValueError with the file, row and column that are wrong; the header is row 1.
    """
    parts = ("recordingMeta", "tracksMeta", "tracks", "ego", "labels")
    meta_file, about_file, tracks_file, ego_file, labels_file = (Path(folder) / f"{number:02d}_{p}.csv" for p in parts)
    meta = Table(meta_file, "frameRate", "duration")
    meta.check("frameRate", meta["frameRate"] > 0, "is not above 0")
    frames = np.rint(meta["duration"] * meta["frameRate"])
    meta.check("duration", (frames > 0) & (frames < 2**31), "is not the time of any number of frames")
    about = Table(about_file, "trackId", "initialFrame", "finalFrame", "numFrames", "class")
    tracks = Table(tracks_file, "trackId", "frame", "xCenter", "yCenter", "heading", "xVelocity", "yVelocity")
    rows = rows_of_tracks(about, tracks)
    frames = int(max(frames[0], about["finalFrame"].max() + 1))  # the duration may be rounded
    labels = read_labels(labels_file, frames) if labels_file.exists() else None
    ego = Table(ego_file, "xCenter", "yCenter", "heading", optional=("toMiddle",))
    middle = float(ego["toMiddle"][0]) if "toMiddle" in ego.columns else None
    poses = seen_from(ego, tracks)
    vehicles = [mine for mine, kind in zip(rows, about["class"], strict=True) if kind in VEHICLES]
    kept = np.concatenate([np.empty(0, int), *vehicles])
    kept = kept[np.argsort(tracks["frame"][kept], kind="stable")]
    cars = np.split(poses[kept], np.searchsorted(tracks["frame"][kept], np.arange(1, frames)))
    labels = np.array([is_safe(frame) for frame in cars]) if labels is None else labels
    return Recording(float(meta["frameRate"][0]), cars, labels, [poses[mine, :2] for mine in vehicles], middle)


class Table:
    """Columns of a CSV file with a header, which may have others: ``class`` is text, all else finite numbers.

    The ``optional`` ones may be missing.
    """

    def __init__(self, file: Path, *columns: str, optional: tuple = ()):
        if not file.is_file():
            raise ValueError(f"{file} is missing")
        lines = file.read_text("utf-8-sig", errors="replace").splitlines()
        if len(lines) < 2:
            raise ValueError(f"{file} has no rows")
        self.file, self.columns = file, {}
        header, *rows = [line.split(",") for line in lines]
        for row, words in enumerate(rows, 2):
            if len(words) != len(header):
                raise ValueError(f"{file}, row {row}: {len(words)} values for {len(header)} columns")
        cells = np.genfromtxt(lines[1:], delimiter=",", comments=None, ndmin=2)  # nan where there is no number
        for column in (*columns, *(name for name in optional if name in header)):
            if column not in header:
                raise ValueError(f"{file}, row 1: there is no column {column}")
            place = header.index(column)
            self.columns[column] = np.array([row[place].strip() for row in rows])
            if column != "class":
                values, whole = cells[:, place], column in WHOLE
                right = (values == np.abs(np.rint(values))) & (values < 2**31) if whole else np.isfinite(values)
                self.check(column, right, f"is not a {'whole number from 0 on' if whole else 'finite number'}")
                self.columns[column] = values.astype(int if whole else float)

    def __getitem__(self, column: str) -> np.ndarray:
        return self.columns[column]

    def check(self, column: str, right: np.ndarray, problem: str) -> None:
        """Raise ValueError for the first row of ``column`` that is not ``right`` (rows,)."""
        if not right.all():
            row = np.argmin(right)
            raise ValueError(f"{self.file}, row {row + 2}, column {column}: '{self[column][row]}' {problem}")


def rows_of_tracks(about: Table, tracks: Table) -> list[np.ndarray]:
    """Return the rows (n,) of each track, whose frames must follow one another and be those of its meta data."""
    tracks.check("trackId", np.isin(tracks["trackId"], about["trackId"]), f"is not in {about.file.name}")
    rows = [np.flatnonzero(tracks["trackId"] == track) for track in about["trackId"]]
    counts, due = np.array([len(mine) for mine in rows]), np.empty(len(tracks["frame"]), int)
    right = (about["numFrames"] == counts) & (counts > 0)
    about.check("numFrames", right, f"is not how many rows the track has in {tracks.file.name}")
    right = about["finalFrame"] == about["initialFrame"] + counts - 1
    about.check("finalFrame", right, "does not agree with initialFrame and numFrames")
    for first, mine in zip(about["initialFrame"], rows, strict=True):
        due[mine] = first + np.arange(len(mine))
    tracks.check("frame", tracks["frame"] == due, "is not the frame that is due in its track")
    return rows


def read_labels(file: Path, frames: int) -> np.ndarray:
    """Return the labels (frames,) bool of a file with a row for every frame, in order."""
    table = Table(file, "frame", "go")
    table.check("frame", table["frame"] == np.arange(len(table["frame"])), "is not the frame that is due")
    table.check("go", table["go"] <= 1, "is neither 0 nor 1")
    if len(table["go"]) != frames:
        raise ValueError(f"{file}, column frame: there are {len(table['go'])} rows for {frames} frames")
    return table["go"] == 1


def seen_from(ego: Table, tracks: Table) -> np.ndarray:
    """Return the poses (n, 4) of all rows of ``tracks`` as the waiting car sees them, as in `Recording.cars`."""
    turn = np.pi / 2 - np.deg2rad(ego["heading"][0])
    offset = tracks["xCenter"] - ego["xCenter"][0] + 1j * (tracks["yCenter"] - ego["yCenter"][0])
    place, speed = offset * np.exp(1j * turn), np.hypot(tracks["xVelocity"], tracks["yVelocity"])
    return np.column_stack([place.real, place.imag, np.deg2rad(tracks["heading"]) + turn, speed])
