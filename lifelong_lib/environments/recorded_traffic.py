"""A recorded junction: the car waits along the recording and chooses when to go (thesis section 5.5.1).

The files are laid out as the public drone recordings (inD, rounD); data/recordings describes them and holds a stand-in
for the thesis's recording, which is not public. Registered as lifelong_lib/RecordedTraffic-v0.
"""

import csv
import re
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import pyarrow
from pyarrow import compute
from pyarrow.csv import ConvertOptions, ReadOptions, read_csv

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
OTHERS = ("bicycle", "pedestrian", "animal")  # which it does not
LAYOUTS = {  # columns that give another layout away
    "psi_rad": "; this looks like INTERACTION's layout: track_id, frame_id, x, y, vx, vy, agent_type and psi_rad (in "
               "degrees) are called trackId, frame, xCenter, yCenter, xVelocity, yVelocity, class and heading here",
    "precedingId": "; this looks like highD's layout, which has no headings, and motorways without junctions",
}  # fmt: skip
MOVING, ASTRAY = 2.0, 20.0  # [m/s], [degrees]: faster cars point where they drive, or are this far off in the median
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
    frames = int(max(frames[0], about["finalFrame"].max() + 1))  # the duration may be rounded
    ego = Table(ego_file, "xCenter", "yCenter", "heading", optional=("toMiddle",))
    middle = float(ego["toMiddle"][0]) if "toMiddle" in ego.columns else None
    poses = whole_tracks(about, tracks, seen_from(ego, tracks))
    labels = read_labels(labels_file, frames) if labels_file.exists() else None
    kinds = np.char.replace(np.char.lower(about["class"]), "-", "_")
    about.check("class", np.isin(kinds, VEHICLES + OTHERS),
                f"is no class known here: seen are {', '.join(VEHICLES)}, and not seen {', '.join(OTHERS)}")
    require_agreeing_headings(tracks)
    vehicles = np.flatnonzero(np.isin(kinds, VEHICLES))
    seen = [poses[vehicle] for vehicle in vehicles]
    times = [about["initialFrame"][vehicle] + np.arange(len(poses[vehicle])) for vehicle in vehicles]
    times, together = (np.concatenate([empty, *parts]) for empty, parts in
                       ((np.empty(0, int), times), (np.empty((0, 4)), seen)))  # fmt: skip
    order = np.argsort(times, kind="stable")
    cars = np.split(together[order], np.searchsorted(times[order], np.arange(1, frames)))
    labels = np.array([is_safe(frame) for frame in cars]) if labels is None else labels
    return Recording(float(meta["frameRate"][0]), cars, labels, [track[:, :2] for track in seen], middle)


class Table:
    """Columns of a CSV file with a header, which may have others: ``class`` is text, all else finite numbers.

    Names count whatever their case, cells may be quoted, lines may be blank. The ``optional`` columns may be missing.
    """

    def __init__(self, file: Path, *columns: str, optional: tuple = ()):
        if not file.is_file():
            raise ValueError(f"{file} is missing")
        with open(file, encoding="utf-8-sig", errors="replace", newline="") as lines:
            header = next(csv.reader(lines), None)
        if header is None:
            raise ValueError(f"{file} has no rows")
        places = {name.strip().lower(): place for place, name in enumerate(header)}
        wanted = [*columns, *(name for name in optional if name.lower() in places)]
        self.file, self.columns = file, {}
        for column in wanted:
            if column.lower() not in places:
                known = "".join(hint for name, hint in LAYOUTS.items() if name.lower() in places)
                raise ValueError(f"{file}, row 1: there is no column {column}{known}")
        names = [str(place) for place in range(len(header))]
        reading = ReadOptions(column_names=names, skip_rows=1, encoding="latin-1", use_threads=False)
        texts = ConvertOptions(column_types=dict.fromkeys(names, pyarrow.string()))
        try:
            cells = read_csv(file, reading, convert_options=texts)
        except pyarrow.ArrowInvalid as error:
            raise ValueError(f"{file}{_told(error)}") from error
        if not len(cells):
            raise ValueError(f"{file} has no rows")
        for column in wanted:
            texts = compute.utf8_trim_whitespace(cells[places[column.lower()]])
            self.columns[column] = np.array(texts.to_pylist()) if column == "class" else self._numbers(column, texts)

    def _numbers(self, column: str, texts: pyarrow.ChunkedArray) -> np.ndarray:
        """What the cells of a column are; nan where there is no number, which is refused at once."""
        try:
            values = compute.cast(texts, pyarrow.float64()).to_numpy()
        except pyarrow.ArrowInvalid:
            values = np.array([float(text) if _is_number(text) else np.nan for text in texts.to_pylist()])
        whole = column in WHOLE
        right = (values == np.abs(np.rint(values))) & (values < 2**31) if whole else np.isfinite(values)
        self.columns[column] = texts
        self.check(column, right, f"is not a {'whole number from 0 on' if whole else 'finite number'}")
        return values.astype(int if whole else float)

    def __getitem__(self, column: str) -> np.ndarray:
        return self.columns[column]

    def check(self, column: str, right: np.ndarray, problem: str) -> None:
        """Raise ValueError for the first row of ``column`` that is not ``right`` (rows,)."""
        if not right.all():
            row = int(np.argmin(right))
            raise ValueError(f"{self.file}, row {row + 2}, column {column}: '{self[column][row]}' {problem}")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _told(error: pyarrow.ArrowInvalid) -> str:
    """Arrow's complaint of a row with other columns, in our words."""
    found = re.search(r"Row #(\d+): Expected (\d+) columns, got (\d+)", str(error))
    return ", row {0}: {2} values for {1} columns".format(*found.groups()) if found else f": {error}".split("\n")[0]


def whole_tracks(about: Table, tracks: Table, poses: np.ndarray) -> list[np.ndarray]:
    """Return each track's poses (n, 4) from its first frame to its last; where frames are missing it drove on evenly.

    ``poses`` (rows, 4) are those of `seen_from`. Frames must follow one another and agree with the meta data.
    """
    tracks.check("trackId", np.isin(tracks["trackId"], about["trackId"]), f"is not in {about.file.name}")
    _, places = np.unique(about["trackId"], return_index=True)
    about.check("trackId", np.isin(np.arange(len(about["trackId"])), places), "stands there twice")
    order = np.argsort(tracks["trackId"], kind="stable")
    ids, frames, poses = tracks["trackId"][order], tracks["frame"][order], poses[order]
    right = np.ones(len(ids), bool)
    right[order[1:]] = (ids[1:] != ids[:-1]) | (frames[1:] > frames[:-1])
    tracks.check("frame", right, "does not come after the frame before it in its track")
    begin, end = (np.searchsorted(ids, about["trackId"], side) for side in ("left", "right"))
    span = about["finalFrame"] - about["initialFrame"] + 1
    right = (end > begin) & ((about["numFrames"] == end - begin) | (about["numFrames"] == span))
    about.check("numFrames", right, f"is not how many rows the track has in {tracks.file.name}")
    for column, rows in (("initialFrame", begin), ("finalFrame", end - 1)):
        about.check(column, about[column] == frames[rows], f"is not what the track has in {tracks.file.name}")
    return [_filled(frames[rows], poses[rows]) for rows in map(slice, begin, end)]


def _filled(frames: np.ndarray, poses: np.ndarray) -> np.ndarray:
    if frames[-1] - frames[0] + 1 == len(frames):
        return poses
    poses = np.column_stack([poses[:, :2], np.unwrap(poses[:, 2]), poses[:, 3]])
    return np.column_stack([np.interp(np.arange(frames[0], frames[-1] + 1), frames, part) for part in poses.T])


def require_agreeing_headings(tracks: Table) -> None:
    """Raise ValueError, with the likely cause, unless those that move point where their velocities do."""
    moving = np.hypot(tracks["xVelocity"], tracks["yVelocity"]) > MOVING
    direction = np.rad2deg(np.arctan2(tracks["yVelocity"], tracks["xVelocity"]))[moving]
    heading = tracks["heading"][moving]
    causes = {"": heading, "they are in radians": np.rad2deg(heading), "its y axis points down": -heading,
              "they are bearings from north": 90 - heading, "they point backwards": heading + 180}  # fmt: skip
    apart = {cause: np.median(np.abs((each - direction + 180) % 360 - 180)) if moving.any() else 0.0
             for cause, each in causes.items()}  # fmt: skip
    cause = min(apart, key=apart.get)
    if apart[""] > ASTRAY:
        advice = f"they agree if {cause}" if apart[cause] < ASTRAY else "one of the two is wrong"
        raise ValueError(f"{tracks.file}, column heading: headings and velocities are {apart['']:.0f} degrees apart in "
                         f"the median; {advice}")  # fmt: skip


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
