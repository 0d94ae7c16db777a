"""Draws the rig in space from the very messages that a log has for Foxglove, still or moving.

Frames are composed from the transforms, and primitives placed in them, as a viewer does; so what
is drawn shows what the messages say, and not what the program meant.
"""

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from trms_cli.core.scene import GHOSTS, TONES
from trms_cli.reporting.style import GREY, INK, PALE, Variant, house_style, new_figure

FloatArray = npt.NDArray[np.float64]
#: A polygon in space, its colour (red, green, blue, opacity).
Face = tuple[FloatArray, tuple[float, float, float, float]]

_SIDES, _WIRE_SIDES = 14, 3
#: Frames of a GIF that its colours are chosen from.
_PALETTE_FRAMES = 8
_LIGHT = np.array([-0.35, -0.6, 0.72])
_SHAPE = 0.75  # height over width
_AZIMUTH, _ELEVATION = -62.0, 18.0  # degrees: the main rotor to the right
_WORDS = {"main": "main rotor", "tail": "tail rotor", "weight": "counterweight"}


@dataclass(frozen=True)
class Shot:
    """A moment of a scene."""

    time: float  #: s
    transforms: Mapping[str, Any]  #: foxglove.FrameTransforms, decoded
    commands: Mapping[str, Any]  #: foxglove.SceneUpdate with the arrows, decoded


def frames_of(transforms: Mapping[str, Any]) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Rotation (3, 3) and origin (3,) in ``base`` of every frame, composed up the tree.

    `transforms`: foxglove.FrameTransforms, parents before children.
    """
    frames = {"base": (np.eye(3), np.zeros(3))}
    for link in transforms["transforms"]:
        rotation, origin = frames[link["parent_frame_id"]]
        at = rotation @ _vector(link["translation"]) + origin
        frames[link["child_frame_id"]] = (rotation @ _rotation(link["rotation"]), at)
    return frames


def draw_scene(
    bodies: Mapping[str, Any],
    shot: Shot,
    *,
    width: float = 120.0,
    style: Variant = "paper",
    title: str = "",
) -> Figure:
    """Draw a moment.

    `bodies`: foxglove.SceneUpdate with the parts, decoded. `width`: mm; the height is three
    quarters of it. `title`: above it; time and angles stand there by default.
    """
    # The library has no types.
    from mpl_toolkits.mplot3d import art3d  # type: ignore[import-untyped]

    frames = frames_of(shot.transforms)
    faces = [
        face
        for update in (bodies, shot.commands)
        for entity in update["entities"]
        if entity["frame_id"] in frames
        for face in _faces(entity, *frames[entity["frame_id"]])
    ]
    reach = _extent(bodies, frames)
    with house_style(style):
        figure = new_figure(width / 25.4, _SHAPE * width / 25.4)
        figure.set_layout_engine("none")
        axes: Any = figure.add_axes((0.16, 0.0, 0.84, 1.0), projection="3d")
        axes.set_axis_off()
        axes.computed_zorder = False
        axes.view_init(elev=_ELEVATION, azim=_AZIMUTH)
        axes.add_collection3d(
            art3d.Line3DCollection(_floor(reach), colors=PALE, linewidths=0.5, zorder=0)
        )
        solid = art3d.Poly3DCollection(
            [corners for corners, _ in faces], linewidths=0.0, zsort="average", zorder=1
        )
        solid.set_facecolor([colour for _, colour in faces])
        solid.set_clip_on(False)
        axes.add_collection3d(solid)
        axes.set_xlim(-reach, reach)
        axes.set_ylim(-reach, reach)
        axes.set_zlim(0.0, 2 * reach)
        axes.set_box_aspect((1, 1, 1), zoom=1.12)
        figure.text(0.02, 0.97, title or _words(shot, frames), va="top", color=INK)
        _legend(figure, bodies)
    return figure


def animate_scene(
    bodies: Mapping[str, Any],
    shots: Sequence[Shot],
    *,
    pixels: int = 380,
    pause: float = 0.1,
    colours: int = 200,
) -> bytes:
    """A GIF of moments, `pause` seconds apart; equal scenes give equal bytes."""
    from PIL import Image

    pictures: list[Any] = []
    for shot in shots:
        figure = draw_scene(bodies, shot, width=100.0, style="paper")
        buffer = io.BytesIO()
        with house_style("paper"):
            figure.savefig(buffer, format="png", dpi=pixels / (100.0 / 25.4))
        pictures.append(Image.open(buffer).convert("RGB"))
    # One palette, no dithering: what stands still costs nothing from frame to frame.
    some = pictures[:: -(-len(pictures) // _PALETTE_FRAMES)]
    sheet = Image.new("RGB", (some[0].width, some[0].height * len(some)))
    for i, picture in enumerate(some):
        sheet.paste(picture, (0, i * picture.height))
    palette = sheet.quantize(colours)
    pictures = [p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures]
    content = io.BytesIO()
    pictures[0].save(
        content,
        format="gif",
        save_all=True,
        append_images=pictures[1:],
        duration=round(1000 * pause),
        loop=0,
        optimize=True,
    )
    return content.getvalue()


def _vector(components: Mapping[str, float]) -> FloatArray:
    return np.array([components["x"], components["y"], components["z"]], dtype=float)


def _rotation(quaternion: Mapping[str, float]) -> FloatArray:
    """The matrix of a unit quaternion."""
    x, y, z, w = (float(quaternion[key]) for key in ("x", "y", "z", "w"))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _faces(entity: Mapping[str, Any], rotation: FloatArray, origin: FloatArray) -> Iterator[Face]:
    """Shaded polygons of an entity's primitives in the base's frame."""
    for primitive in entity["cylinders"]:
        size = _vector(primitive["size"])
        shape = _barrel(0.5 * size[0], 0.5 * size[0], -0.5 * size[2], 0.5 * size[2])
        yield from _placed(shape, primitive, rotation, origin)
    for primitive in entity["lines"]:
        points = np.array([_vector(point) for point in primitive["points"]])
        yield from _placed(_wire(points, primitive["thickness"]), primitive, rotation, origin)
    for primitive in entity["arrows"]:
        shaft, head = primitive["shaft_length"], primitive["head_length"]
        thin, wide = 0.5 * primitive["shaft_diameter"], 0.5 * primitive["head_diameter"]
        along_z = [*_barrel(thin, thin, 0.0, shaft), *_barrel(wide, 0.0, shaft, shaft + head)]
        # An arrow points along x.
        shape = [corners[:, [2, 0, 1]] for corners in along_z]
        yield from _placed(shape, primitive, rotation, origin)


def _placed(
    shape: Sequence[FloatArray],
    primitive: Mapping[str, Any],
    rotation: FloatArray,
    origin: FloatArray,
) -> Iterator[Face]:
    turned = rotation @ _rotation(primitive["pose"]["orientation"])
    at = rotation @ _vector(primitive["pose"]["position"]) + origin
    colour = np.array([primitive["color"][key] for key in "rgb"])
    for corners in shape:
        placed = corners @ turned.T + at
        normal = np.cross(placed[1] - placed[0], placed[2] - placed[1])
        norm = float(np.linalg.norm(normal))
        light = abs(float(normal @ _LIGHT)) / norm if norm else 0.0
        red, green, blue = np.clip(colour * (0.62 + 0.38 * light), 0.0, 1.0).tolist()
        yield placed, (red, green, blue, float(primitive["color"]["a"]))


def _barrel(below: float, above: float, low: float, high: float) -> list[FloatArray]:
    """A cylinder or a cone along z: its sides, and its ends."""
    turns = np.linspace(0.0, 2 * np.pi, _SIDES + 1)
    circle = np.column_stack([np.cos(turns), np.sin(turns)])
    one = np.column_stack([below * circle, np.full(len(turns), low)])
    other = np.column_stack([above * circle, np.full(len(turns), high)])
    sides = [np.array([one[i], one[i + 1], other[i + 1], other[i]]) for i in range(_SIDES)]
    return [*sides, *_disc(one[:-1]), *(_disc(other[:-1]) if above else [])]


def _disc(rim: FloatArray) -> list[FloatArray]:
    """A flat end in strips of four corners, as all faces have."""
    return [
        np.array([rim[i], rim[i + 1], rim[-2 - i], rim[-1 - i]]) for i in range(len(rim) // 2 - 1)
    ]


def _wire(points: FloatArray, thickness: float) -> list[FloatArray]:
    """A closed wire around z through points: a strip of faces around each piece."""
    radius = 0.5 * thickness
    turns = np.linspace(0.0, 2 * np.pi, _WIRE_SIDES + 1)
    outward = points / np.linalg.norm(points, axis=1, keepdims=True)
    rings = [
        point + radius * (np.outer(np.cos(turns), out) + np.outer(np.sin(turns), [0.0, 0.0, 1.0]))
        for point, out in zip(points, outward, strict=True)
    ]
    return [
        np.array([one[i], one[i + 1], other[i + 1], other[i]])
        for one, other in zip(rings, [*rings[1:], rings[0]], strict=True)
        for i in range(_WIRE_SIDES)
    ]


def _extent(
    bodies: Mapping[str, Any], frames: Mapping[str, tuple[FloatArray, FloatArray]]
) -> float:
    """Half the side of a cube that holds the rig at any angle, m."""
    height = float(frames["yaw"][1][2])
    farthest = max(
        float(np.linalg.norm(_vector(part["pose"]["position"])))
        for entity in bodies["entities"]
        if entity["frame_id"] == "beam"
        for part in [*entity["cylinders"], *entity["lines"]]
    )
    return 0.95 * max(farthest, 0.75 * height)


def _floor(reach: float) -> list[FloatArray]:
    steps = np.linspace(-1.4 * reach, 1.4 * reach, 9)
    edge = 1.4 * reach
    along = [np.array([[x, -edge, 0.0], [x, edge, 0.0]]) for x in steps]
    return along + [np.array([[-edge, y, 0.0], [edge, y, 0.0]]) for y in steps]


def _words(shot: Shot, frames: Mapping[str, tuple[FloatArray, FloatArray]]) -> str:
    """Time, and the angles as they are read off the beam's axis."""
    along = frames["beam"][0][:, 0]
    yaw, pitch = np.arctan2(along[1], along[0]), np.arcsin(np.clip(along[2], -1, 1))
    return f"{shot.time:6.2f} s    pitch {pitch:+.2f} rad    yaw {yaw:+.2f} rad"


def _legend(figure: Figure, bodies: Mapping[str, Any]) -> None:
    """What the colours mean, of those that occur."""
    there = {entity["id"] for entity in bodies["entities"]}
    weighted = any(
        tuple(part["color"][key] for key in "rgb") == TONES["weight"]
        for entity in bodies["entities"]
        for part in entity["cylinders"]
    )
    tones = ["main", "tail", *(["weight"] if weighted else [])]
    tones += [ghost for ghost in GHOSTS if ghost in there]
    handles = [
        Line2D([], [], color=TONES[tone], linewidth=4, alpha=0.6 if tone in GHOSTS else 1.0)
        for tone in tones
    ]
    figure.legend(
        handles,
        [_WORDS.get(tone, tone) for tone in tones],
        loc="upper left",
        ncols=1,
        bbox_to_anchor=(0.005, 0.93),
        handlelength=0.9,
        labelspacing=0.3,
        labelcolor=GREY,
    )
