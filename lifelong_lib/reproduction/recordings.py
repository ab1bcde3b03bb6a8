"""Roll-outs as rerun recordings: several policies on one system, side by side, and a still picture of the same moments.

Recordings are logged in whole columns and without wall-clock times, so that equal roll-outs pass `rerun rrd compare`,
although the bytes of their files differ (rerun writes fresh ids into each).
"""

import itertools
import os
import re
import tempfile
import textwrap
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib import colors, style
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from rerun.archetypes import RecordingInfo
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation

from lifelong_lib.reproduction.files import ReproductionError, require
from lifelong_lib.reproduction.runs import Chapter

_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])  # of the box of half size 1
_FACES = np.array([[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]])
_REACH = 2  # views end so many body sizes from the start: one runaway must not shrink the others
_MOMENTS = 9  # overlaid in the still picture
_LINE_STYLES = ("-", "--", "-.", ":")  # besides the colours, for grey print


@dataclass(frozen=True)
class Scene:
    """One roll-out of H steps of one policy, as things to draw (metres, z upwards).

    colour: of all that moves and of the lines over time; any colour matplotlib knows.
    parts: {name: (H+1, n >= 2, 3)}, polylines that move.
    boxes: {name: (centres (H+1, 3), half sizes (3,), rotations (H+1, 4) as quaternions xyzw)}.
    series: {name: (H+1,)}, values over time.
    fixed: {name: (n >= 2, 3)}, grey polylines that stay: a rail, a target.
    outcome: a few words for the title, such as "falls after 0.8 s".
    crowds: {name: (centres (H+1, n, 3), half sizes (3,), rotations (H+1, n, 4))}, dark boxes that are not the subject.
    images: {name: (H+1, rows, columns, 3)} from 0 to 1, row 0 below: what the subject sees.
    moment: of which the still picture shows crowds and images, as they would hide each other.
    """

    colour: str
    parts: dict = field(default_factory=dict)
    boxes: dict = field(default_factory=dict)
    series: dict = field(default_factory=dict)
    fixed: dict = field(default_factory=dict)
    outcome: str = ""
    crowds: dict = field(default_factory=dict)
    images: dict = field(default_factory=dict)
    moment: int = 0

    def faces(self):
        """The six faces (H+1, 6, 4, 3) of every box."""
        yield from (_faces(*box) for box in self.boxes.values())

    def points(self):
        """Every point (H+1, n, 3) that moves."""
        moving = [*map(np.asarray, self.parts.values()), *self.faces()]
        return np.concatenate([points.reshape(len(points), -1, 3) for points in moving], axis=1)


def _faces(centres, half_sizes, rotations):
    turns = Rotation.from_quat(rotations).as_matrix()
    return (_CORNERS * half_sizes @ np.swapaxes(turns, -1, -2) + np.asarray(centres)[..., None, :])[..., _FACES, :]


def save_recording(chapter: Chapter, name: str, scenes: dict[str, Scene], seconds_per_step: float,
                   series_units: dict[str, str], caption: str, seen_from: tuple = (0, -1, 0), window=None) -> Path:
    """Write `<chapter.folder>/recordings/<name>.rrd`, verified by rerun, and a still picture `<name>.png` beside it.

    scenes: {title: Scene}, equally long, with the same series; shown side by side on one timeline of simulated seconds.
    series_units: {series name: unit}; one plot over time each, with one line a scene.
    caption: what one should see, and what in it is a stand-in.
    seen_from: direction from the scene towards the viewer, not vertical; (0, -1, 0): x to the right, z upwards.
    window: (low (3,), high (3,)) [m], corners of what the views show; None: where the subject moves.

    Returns the path of the .rrd. Raises ReproductionError for scenes that cannot be drawn (wrong shapes, values that
    are not finite) and when the files cannot be written; an earlier recording of this name then stays as it was.
    """
    require(re.fullmatch(r"[\w-]+", name), f"recording name {name!r}: use letters, digits, '-' and '_' only")
    where = f"recording {name!r}"
    require(0 < seconds_per_step < np.inf, f"{where}: seconds_per_step is {seconds_per_step}; give a positive number")
    require(0 < np.hypot(*seen_from[:2]) < np.inf, f"{where}: seen_from is {seen_from}; give one that is not vertical")
    require(scenes and series_units, f"{where}: give at least one scene, {{title: Scene(...)}}, and one series")
    _check(where, scenes, series_units)
    corners = np.array(list(itertools.product(*np.transpose(window)))) if window else None
    shown = (scenes, seconds_per_step, series_units, caption, np.array(seen_from) / np.linalg.norm(seen_from), corners)
    path = chapter.folder / "recordings" / f"{name}.rrd"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(suffix=".part", dir=path.parent) as part:
            recording, still = Path(part, path.name), Path(part, f"{name}.png")
            _write_recording(recording, name, *shown)
            verify_recording(recording)
            _write_still(still, *shown)
            os.replace(recording, path)
            os.replace(still, path.with_suffix(".png"))
    except (OSError, RuntimeError) as error:  # rerun reports a full disk as RuntimeError
        raise ReproductionError(f"cannot write {path} ({error}); is there space, may you write there?") from error
    return path


def equally_long(scenes: dict[str, Scene]) -> dict[str, Scene]:
    """Return the scenes with the last moment of the shorter ones held until the longest ends."""
    require(all(scene.series for scene in scenes.values()), "scenes of any length need a series each, to measure it")
    longest = max(len(values) for scene in scenes.values() for values in scene.series.values())

    def held(values):
        return values[np.minimum(np.arange(longest), len(values) - 1)]

    def held_boxes(boxes):
        return {key: (held(centres), half_sizes, held(turns)) for key, (centres, half_sizes, turns) in boxes.items()}

    made = {}
    for title, scene in scenes.items():
        plain = {kind: {key: held(values) for key, values in getattr(scene, kind).items()}
                 for kind in ("parts", "series", "images")}  # fmt: skip
        made[title] = replace(scene, boxes=held_boxes(scene.boxes), crowds=held_boxes(scene.crowds), **plain)
    return made


def verify_recording(path: Path) -> None:
    """Have rerun read the file to its end; ReproductionError if it is missing, cut short, garbled or no recording.

    A changed number inside a well-formed file passes: only comparing with another recording shows that.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # of a file without its end rerun only warns
            for _ in RrdReader(path).stream():
                pass
    except (RuntimeError, ValueError, Warning) as error:
        cause = " ".join(str(error).split())
        raise ReproductionError(f"recording {path} cannot be read ({cause}); run its chapter again") from error


def _check(where, scenes, series_units):
    """ReproductionError unless every array of every scene is finite and all fit together."""
    moments = None
    for title, scene in scenes.items():
        here = f"{where}, scene {title!r}"
        require((scene.parts or scene.boxes) and scene.series.keys() == series_units.keys(),
                f"{here}: give a part or box to draw, and exactly the series {list(series_units)}")
        arrays = [(f"series {key!r}", values, "H+1") for key, values in scene.series.items()]
        arrays += [(f"part {key!r}", points, "H+1", "n", 3) for key, points in scene.parts.items()]
        arrays += [(f"fixed {key!r}", line, "n", 3) for key, line in scene.fixed.items()]
        for kind, boxes, count in (("box", scene.boxes, []), ("crowd", scene.crowds, ["any"])):
            for key, (centres, half_sizes, turns) in boxes.items():
                arrays += [(f"half sizes of {kind} {key!r}", half_sizes, 3)]
                arrays += [(f"centres of {kind} {key!r}", centres, "H+1", *count, 3)]
                arrays += [(f"rotations of {kind} {key!r}", turns, *np.shape(centres)[:-1], 4)]
        arrays += [(f"image {key!r}", values, "H+1", "n", "n", 3) for key, values in scene.images.items()]
        length = len(next(iter(scene.series.values())))
        require(0 <= scene.moment < max(length, 1), f"{here}: moment {scene.moment} is not one of the {length}")
        for what, values, *wanted in arrays:
            try:
                array = np.asarray(values, dtype=float)
            except (TypeError, ValueError):
                raise ReproductionError(f"{here}, {what}: not an array of numbers") from None
            moments = moments or array.size  # the first series says how long all have to be
            wanted = [moments if length == "H+1" else length for length in wanted]
            fits = [want in (have, "any") or (want == "n" and have > 1)
                    for have, want in zip(array.shape, wanted, strict=False)]  # fmt: skip
            require(moments > 1 and len(wanted) == array.ndim and all(fits),
                    f"{here}, {what}: shape {array.shape}, wanted ({', '.join(map(str, wanted))})")
            bad_rows = np.nonzero(~np.isfinite(array))[0]
            require(len(bad_rows) == 0,
                    f"{here}, {what}: not finite at row {min(bad_rows, default='')}; end all roll-outs before that")


def _window(points, corners=None):
    """Low and high corner (d,) of what the views show of points (H+1, n, d): not what goes far beyond the start."""
    if corners is not None:
        return corners.min(axis=0), corners.max(axis=0)
    low, high = points[0].min(axis=0), points[0].max(axis=0)
    reach = _REACH * (high - low).max() or np.inf  # a point has no size
    return np.maximum(points.min(axis=(0, 1)), low - reach), np.minimum(points.max(axis=(0, 1)), high + reach)


def _write_recording(path, name, scenes, seconds_per_step, series_units, caption, backwards, corners):
    moments = len(next(iter(scenes.values())).points())
    times = [rr.TimeColumn("time", duration=np.arange(moments) * seconds_per_step)]
    # Only send_columns: rows logged one by one are cut into chunks by the wall clock, and no two files compare equal.
    with rr.RecordingStream(f"lifelong_lib {name}", send_properties=False) as recording:
        recording.save(path, default_blueprint=_layout(name, scenes, series_units, backwards, corners))

        def send(kind, *names, static, moving=None):
            entity = "/".join(["", kind, *map(rr.escape_entity_path_part, names)])
            recording.send_columns(entity, [], static, strict=True)
            if moving is not None:
                recording.send_columns(entity, times, moving, strict=True)

        recording.send_columns(rr.RECORDING_PROPERTIES_PATH, [], RecordingInfo.columns(name=[name]), strict=True)
        send("caption", static=rr.TextDocument.columns(text=[caption]))
        for title, scene in scenes.items():
            colour = [[round(255 * share) for share in colors.to_rgb(scene.colour)]]
            for key, line in scene.fixed.items():
                send("scenes", title, "fixed", key, static=rr.LineStrips3D.columns(strips=[line]))
            for key, points in scene.parts.items():
                send("scenes", title, "parts", key, moving=rr.LineStrips3D.columns(strips=list(points)),
                     static=rr.LineStrips3D.columns(colors=colour, radii=rr.Radius.ui_points([2.5])))
            for kind, boxes, own in (("boxes", scene.boxes, colour), ("crowds", scene.crowds, None)):
                for key, (centres, half_sizes, turns) in boxes.items():
                    count = np.size(centres) // (3 * moments)  # of boxes at a moment
                    places = rr.Boxes3D.columns(centers=np.reshape(centres, (-1, 3)),
                                                quaternions=np.reshape(turns, (-1, 4)))  # fmt: skip
                    look = rr.Boxes3D.columns(half_sizes=[half_sizes] * count, colors=own, fill_mode=["solid"] * count)
                    send("scenes", title, kind, key, moving=places.partition([count] * moments),
                         static=look.partition([count]))
            for key, values in scene.images.items():
                pixels = np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)[:, ::-1]
                kind = rr.components.ImageFormat(width=pixels.shape[2], height=pixels.shape[1], color_model="RGB",
                                                 channel_datatype="U8")  # fmt: skip
                send("images", title, key, static=rr.Image.columns(format=[kind]),
                     moving=rr.Image.columns(buffer=pixels.reshape(moments, -1)))
            for key, values in scene.series.items():
                send("series", key, title, moving=rr.Scalars.columns(scalars=values),
                     static=rr.SeriesLines.columns(names=[title], colors=colour, widths=[2]))
    recording.disconnect()


def _layout(name, scenes, series_units, backwards, corners):
    """The viewer's windows: a 3-D view a scene, all with the same camera; below images, the series and the caption."""
    low, high = _window(np.concatenate([scene.points() for scene in scenes.values()], axis=1), corners)
    middle = (low + high) / 2
    camera = rrb.EyeControls3D(position=middle + 1.2 * np.linalg.norm(high - low) * backwards, look_target=middle)
    views = [rrb.Spatial3DView(origin=f"/scenes/{rr.escape_entity_path_part(title)}", eye_controls=camera,
                               name=f"{title}: {scene.outcome}" if scene.outcome else title)
             for title, scene in scenes.items()]
    plots = [rrb.TimeSeriesView(origin=f"/series/{rr.escape_entity_path_part(key)}", name=f"{key} [{unit}]")
             for key, unit in series_units.items()]
    below = rrb.Horizontal(*plots, rrb.TextDocumentView(origin="/caption", name=name))
    images = [rrb.Spatial2DView(origin="/".join(["/images", *map(rr.escape_entity_path_part, (title, key))]),
                                name=f"{title}: {key}")
              for title, scene in scenes.items() for key in scene.images]  # one view each, or they hide each other
    middle = [rrb.Horizontal(*images)] if images else []
    return rrb.Blueprint(rrb.Vertical(rrb.Grid(*views), *middle, below, row_shares=[3, *[2 for _ in middle], 2]),
                         rrb.TimePanel(timeline="time", loop_mode="all"), auto_views=False, collapse_panels=True)


def _write_still(path, scenes, seconds_per_step, series_units, caption, backwards, corners):
    right = np.cross([0, 0, 1], backwards) / np.linalg.norm(backwards[:2])
    camera = np.stack([right, np.cross(backwards, right)], axis=1)  # (3, 2), parallel projection
    points = np.concatenate([scene.points() @ camera for scene in scenes.values()], axis=1)
    low, high = _window(points, corners if corners is None else corners @ camera)
    margin = 0.05 * max(high - low) or 1.0  # [m] around a body that is seen from its end
    (left, bottom), (right, top) = low - margin, high + margin
    seen = [scene.images for scene in scenes.values() if scene.images]
    heights = [np.clip(10 / len(scenes) * (top - bottom) / (right - left), 1.5, 5) + 0.7, *[2.0][: len(seen)], 2.6]
    with style.context("default"):
        figure = Figure(figsize=(10, sum(heights) + 0.4), layout="constrained")  # [inch]
        upper, *middle, lower = figure.subfigures(len(heights), 1, height_ratios=heights)
        views = upper.subplots(1, len(scenes), squeeze=False)[0]
        plots = lower.subplots(1, len(series_units), squeeze=False)[0]
        for figure_of_images in middle:
            _draw_images(figure_of_images, scenes, seconds_per_step)
        for view, line_style, (title, scene) in zip(views, itertools.cycle(_LINE_STYLES), scenes.items(), strict=False):
            view.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xticks=[], yticks=[])
            view.set_xlabel(textwrap.fill(scene.outcome, max(100 // len(scenes), 12)))
            view.set_title(title, color=scene.colour, fontweight="bold")
            _draw_moments(view, scene, camera)
            for plot, (key, unit) in zip(plots, series_units.items(), strict=True):
                times = np.arange(len(scene.series[key])) * seconds_per_step
                plot.plot(times, scene.series[key], color=scene.colour, linestyle=line_style, label=title)
                plot.set(xlim=(0, times[-1]), xlabel="time [s]", ylabel=f"{key} [{unit}]")
        plots[0].legend(fontsize=8, frameon=False)
        caption += f" Upper row: views {right - left:.2g} m wide, pale at the start, dark after {times[-1]:g} s."
        figure.supxlabel(textwrap.fill(caption, 150), fontsize=8)
        figure.savefig(path, format="png", dpi=120, metadata={"Software": None})  # a version would change the bytes


def _draw_images(figure, scenes, seconds_per_step):
    seen = [(scene, name, values) for scene in scenes.values() for name, values in scene.images.items()]
    for axes, (scene, name, values) in zip(figure.subplots(1, len(seen), squeeze=False)[0], seen, strict=True):
        axes.imshow(np.clip(values[scene.moment], 0, 1), origin="lower", interpolation="nearest")
        axes.set(xticks=[], yticks=[], xlabel=f"{name} after {scene.moment * seconds_per_step:g} s")


def _draw_moments(axes, scene, camera):
    for line in scene.fixed.values():
        axes.plot(*(np.asarray(line) @ camera).T, color="0.8", zorder=0)
    for centres, half_sizes, turns in scene.crowds.values():
        boxes = _faces(np.asarray(centres)[scene.moment], half_sizes, np.asarray(turns)[scene.moment]) @ camera
        axes.add_collection(PolyCollection(boxes.reshape(-1, 4, 2), facecolors="0.35", edgecolors="0.35", zorder=1))
    own = np.array(colors.to_rgb(scene.colour))
    for order, moment in enumerate(np.linspace(0, len(scene.points()) - 1, _MOMENTS).round().astype(int)):
        strength = 0.15 + 1.05 * (order / (_MOMENTS - 1)) ** 2  # 0: white, 1: the scene's colour, above: darker
        colour = [1 - strength * (1 - own) if strength < 1 else own * (2 - strength)]
        boxes = [face @ camera for faces in scene.faces() for face in faces[moment]]
        lines = [np.asarray(points)[moment] @ camera for points in scene.parts.values()]
        axes.add_collection(PolyCollection(boxes, facecolors=colour, edgecolors=colour, zorder=order))
        axes.add_collection(LineCollection(lines, colors=colour, linewidths=2, zorder=order))
