"""Makes the stand-in for a recorded junction (thesis section 5.5.1): two recordings. Run: python make.py [folder]

A car waits at the line of a minor road to turn left into a curved main road; a tracker in it records who drives past,
and an observer beside the driver says whether to go. Nothing is shared with the SUMO junctions of data/intersections,
neither the plan nor the traffic nor what is seen of it. README.md gives the reasons for the numbers.
"""

import sys
from pathlib import Path

import numpy as np

SEED = 551
RECORDINGS = {0: 60, 1: 60}  # number: seconds; 0 is to learn from, 1 to test on
RATE = 25  # frames a second

NEAR, FAR = 1, -1  # the lanes: their side of the median, and their traffic's sense along x

# The junction, with the middle of the main road as x axis where the minor road meets it from below.
RADIUS = 400.0  # [m] of the main road's middle, which bends away from the waiting car
LANE, MEDIAN, SETBACK = 3.6, 2.0, 3.0  # [m] width of a lane and of the painted median; line to lane edge
MEETING = np.deg2rad(84)  # between main and minor road
PLACE, BEARING = np.array([62.0, 41.0]), np.deg2rad(23)  # of the junction in the frame of the recording

# Traffic, in each direction: Gipps' car-following model (1981) with his spreads, and the speed limit in place of his.
FLOW, HEADWAY = 1 / 6, 1.6  # cars a second; [s] at least between two that arrive
LIMIT, SPREAD = 15.6, 0.1  # [m/s] 35 mph, and the relative spread of wished speeds
TAU = 17 / RATE  # [s] reaction time and step of the model: 2/3 s, rounded to frames
START, WARM_UP = -220.0, 30.0  # cars arrive so far [m] before the junction, from so long [s] before the recording

# The tracker: (standard deviation, seconds of memory) of its errors.
POSITION, SPEED, HEADING, ACCELERATION = (0.3, 1.0), (0.5, 0.5), (np.deg2rad(2), 0.5), (0.3, 0.5)
RANGE, RANGE_SPREAD = 100.0, 5.0  # [m] from the waiting car's front
LATE, LATE_RANGE = 0.15, (30, 60)  # share of cars that are found only when they are so near [m]
LOSSES, LOST = 0.05, (0.2, 1.0)  # a second and car; [s] that a loss lasts
CONFIRMED = 0.4  # [s] that a track must last to be reported

# The observer.
FREE = {NEAR: (0.5, 4.0), FAR: (1.5, 5.0)}  # [s] from now, from when and until when a lane must be free of cars
MISJUDGED = 0.1  # relative standard deviation of the error about the time until a car is there
LAG, LAG_SPREAD = 0.3, 0.05  # [s] of reaction

TRACKS = ("recordingId,trackId,frame,trackLifetime,xCenter,yCenter,heading,width,length,"
          "xVelocity,yVelocity,xAcceleration,yAcceleration")  # fmt: skip
TRACKS_META = "recordingId,trackId,initialFrame,finalFrame,numFrames,width,length,class"
RECORDING_META = "recordingId,locationId,frameRate,speedLimit,weekday,startTime,duration,numTracks,numVehicles"


def ego() -> tuple[np.ndarray, float]:
    """Front (2,) and heading of the waiting car on the plan of the junction."""
    back = MEDIAN / 2 + LANE + SETBACK
    return np.array([-back / np.tan(MEETING), -back]), MEETING


def path(lane: int, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 2) and headings (n,) so far along a lane, on the plan; 0 is in front of the waiting car."""
    radius = RADIUS + lane * (MEDIAN + LANE) / 2
    angle = along / radius
    x, y = lane * radius * np.sin(angle), RADIUS - radius * np.cos(angle)
    return np.column_stack([x, y]), lane * angle + (np.pi if lane == FAR else 0)


def to_frame(points: np.ndarray, headings):
    """From the plan to the frame of the recording."""
    cos, sin = np.cos(BEARING), np.sin(BEARING)
    return PLACE + points @ np.array([[cos, sin], [-sin, cos]]), headings + BEARING


# ------------------------------------------------------------------------------------------------------------- traffic

def gipps(speed, wish, acceleration, gap, ahead):
    """Speed after TAU: as fast as wished, and slow enough to stop in ``gap`` [m] behind a car of speed ``ahead``."""
    braking = 2 * acceleration
    expected = max(3.0, (braking + 3) / 2)  # of the car ahead
    free = speed + 2.5 * acceleration * TAU * (1 - speed / wish) * np.sqrt(0.025 + speed / wish)
    room = (braking * TAU) ** 2 + braking * (2 * gap - speed * TAU + ahead**2 / expected)
    return max(0.0, min(free, np.sqrt(max(room, 0.0)) - braking * TAU))


def drive(rng: np.random.Generator, seconds: int) -> list[dict]:
    """The cars of one lane: size, and along [m], speed, acceleration in every frame (nan before a car has arrived)."""
    times, frames = np.arange(-WARM_UP, seconds + TAU, TAU), np.arange(seconds * RATE) / RATE
    last = np.minimum(np.searchsorted(times, frames, side="right") - 1, len(times) - 2)
    cars, arrival, leader = [], -WARM_UP, None
    while (arrival := arrival + HEADWAY + rng.exponential(1 / FLOW - HEADWAY)) < seconds:
        wish, acceleration = rng.normal(LIMIT, SPREAD * LIMIT), rng.normal(1.7, 0.3)
        size = {"length": round(rng.normal(4.6, 0.3), 1), "width": round(rng.normal(1.8, 0.1), 1)}
        along, speed = np.full(len(times), np.nan), np.full(len(times), np.nan)
        first = np.searchsorted(times, arrival)
        speed[first] = min(wish, leader["steps"][1][first]) if leader else wish
        along[first] = START + speed[first] * (times[first] - arrival)
        for k in range(first, len(times) - 1):
            gap, ahead = np.inf, 0.0
            if leader:
                x, ahead = leader["steps"][0][k], leader["steps"][1][k]
                gap = x - along[k] - (leader["length"] + size["length"]) / 2 - 2  # 2 m stay between cars that stand
            speed[k + 1] = gipps(speed[k], wish, acceleration, gap, ahead)
            along[k + 1] = along[k] + TAU * (speed[k] + speed[k + 1]) / 2
        gain, since = np.diff(speed)[last] / TAU, frames - times[last]  # Gipps' speeds are linear between his steps
        leader = size | {"steps": (along, speed), "acceleration": gain, "speed": speed[last] + gain * since,
                         "along": along[last] + speed[last] * since + gain * since**2 / 2}  # fmt: skip
        cars.append(leader)
    return cars


# ------------------------------------------------------------------------------------------------------------- tracker

def wander(rng, frames: int, spread: float, memory: float) -> np.ndarray:
    """Errors (frames,) of standard deviation ``spread`` that are forgotten in about ``memory`` seconds."""
    kept = np.exp(-1 / (RATE * memory))
    errors = spread * rng.standard_normal(frames)
    for i in range(1, frames):
        errors[i] = kept * errors[i - 1] + np.sqrt(1 - kept**2) * errors[i]
    return errors


def seen(rng, distance: np.ndarray) -> np.ndarray:
    """First frames and those after the last (n, 2) of the tracks that the tracker makes of one car."""
    visible = distance < rng.normal(RANGE, RANGE_SPREAD)
    if rng.random() < LATE:
        near = np.flatnonzero(distance < rng.uniform(*LATE_RANGE))
        visible[: near[0] if len(near) else None] = False
    for start in np.flatnonzero(rng.random(len(visible)) < LOSSES / RATE):
        visible[start : start + round(rng.uniform(*LOST) * RATE)] = False
    ends = np.flatnonzero(np.diff(np.concatenate([[0], visible, [0]]))).reshape(-1, 2)
    return ends[np.diff(ends)[:, 0] >= CONFIRMED * RATE]


def track(rng, lane: int, car: dict, first: int, end: int) -> dict:
    """What the tracker reports of a car from its frame ``first`` to ``end``: meta data and rows (n, 7)."""
    along, speed, acceleration = (car[key][first:end] for key in ("along", "speed", "acceleration"))
    (points, heading), n = to_frame(*path(lane, along)), end - first
    points = points + np.column_stack([wander(rng, n, *POSITION), wander(rng, n, *POSITION)])
    heading, speed = heading + wander(rng, n, *HEADING), speed + wander(rng, n, *SPEED)
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    left = ahead[:, ::-1] * (-1, 1)
    acceleration = acceleration + wander(rng, n, *ACCELERATION)
    accelerations = acceleration[:, None] * ahead + lane * (speed**2 / RADIUS)[:, None] * left
    rows = np.column_stack([points, np.rad2deg(heading) % 360, speed[:, None] * ahead, accelerations])
    return {"first": first, "rows": rows, "length": car["length"], "width": car["width"]}


def tracks(rng, lanes: dict[int, list]) -> list[dict]:
    """All tracks of a recording, in the order in which they begin."""
    made = []
    for lane, cars in lanes.items():
        for car in cars:
            distance = np.linalg.norm(path(lane, car["along"])[0] - ego()[0], axis=1)
            made += [track(rng, lane, car, *ends) for ends in seen(rng, distance)]
    return sorted(made, key=lambda track: track["first"])


# ------------------------------------------------------------------------------------------------------------ observer

def blocks(rng, car: dict, begins: float, ends: float) -> np.ndarray:
    """Frames in which the observer finds that a car will drive past us between these times from now: bool (frames,)."""
    judged = 1 + rng.normal(0, MISJUDGED)
    front, rear = (-judged * (car["along"] + end * car["length"] / 2) / car["speed"] for end in (1, -1))
    return (front < ends) & (rear > begins)


def says(rng, safe: np.ndarray) -> np.ndarray:
    """What the observer says, whose every change of mind comes after a lag."""
    changes = np.flatnonzero(np.diff(safe)) + 1
    heard = changes + np.rint(rng.normal(LAG, LAG_SPREAD, len(changes)) * RATE).astype(int)
    said = np.full(len(safe), safe[0])
    for frame in np.maximum.accumulate(heard):
        said[frame:] = ~said[frame:]
    return said


# --------------------------------------------------------------------------------------------------------------- files

def write(file: Path, header: str, rows: list[str]) -> None:
    file.write_text("\n".join([header, *rows, ""]), newline="\n")


def record(number: int, seconds: int, folder: Path) -> None:
    """Write the five files of a recording."""
    traffic, tracker, observer = map(np.random.default_rng, np.random.SeedSequence([SEED, number]).spawn(3))
    lanes = {lane: drive(traffic, seconds) for lane in (NEAR, FAR)}
    blocked = [blocks(observer, car, *FREE[lane]) for lane, cars in lanes.items() for car in cars]
    go = says(observer, ~np.any(blocked, axis=0))
    made = tracks(tracker, lanes)
    rows, meta = [], []
    for i, one in enumerate(made):
        first, n, size = one["first"], len(one["rows"]), f"{one['width']:.1f},{one['length']:.1f}"
        meta += [f"{number},{i},{first},{first + n - 1},{n},{size},car"]
        for age, (x, y, heading, vx, vy, ax, ay) in enumerate(one["rows"]):
            moves = f"{vx:.1f},{vy:.1f},{ax:.1f},{ay:.1f}"
            rows += [f"{number},{i},{first + age},{age},{x:.2f},{y:.2f},{heading:.1f},{size},{moves}"]
    (x, y), heading = to_frame(*ego())
    write(folder / f"{number:02d}_tracks.csv", TRACKS, rows)
    write(folder / f"{number:02d}_tracksMeta.csv", TRACKS_META, meta)
    about = f"{number},0,{RATE},{LIMIT},none,0,{seconds},{len(made)},{len(made)}"
    write(folder / f"{number:02d}_recordingMeta.csv", RECORDING_META, [about])
    write(folder / f"{number:02d}_labels.csv", "frame,go", [f"{frame},{label:d}" for frame, label in enumerate(go)])
    ahead = (MEDIAN / 2 + LANE + SETBACK) / np.sin(MEETING)
    write(folder / f"{number:02d}_ego.csv", "xCenter,yCenter,heading,toMiddle",
          [f"{x:.2f},{y:.2f},{np.rad2deg(heading):.1f},{ahead:.2f}"])  # fmt: skip


if __name__ == "__main__":
    for number, seconds in RECORDINGS.items():
        record(number, seconds, Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
