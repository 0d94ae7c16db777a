"""The 3D view in a run's log: its geometry, its schemas, and readers that pass it by."""

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from mcap.reader import make_reader

from trms_cli.cli import main
from trms_cli.library.tasks.scene import scene_of_log
from trms_cli.recordings.export import export_log
from trms_cli.recordings.foxglove.scene_log import scene_messages
from trms_cli.recordings.foxglove.types import SCENE_TOPICS, layout
from trms_cli.recordings.log_reader import LogTail, TopicTable, read_log
from trms_cli.reporting.scene_picture import frames_of

ROOT = Path(__file__).parents[2]
SHORT = ("sim.duration=2", "picture=false")


def run(folder: Path, *words: str) -> Path:
    assert main(["run", *SHORT, *words, f"out={folder}"]) == 0
    return folder / "run.mcap"


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    """Two seconds of the default loop, every second sample with a pose."""
    return run(tmp_path_factory.mktemp("scene") / "there", "sim.scene_every=2")


def messages(path: Path) -> dict[str, list[tuple[int, dict, bytes]]]:
    """Time (ns), decoded message and schema of the viewer's topics."""
    found: dict[str, list] = {topic: [] for topic in SCENE_TOPICS}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(topics=SCENE_TOPICS):
            assert schema is not None
            found[channel.topic].append((message.log_time, json.loads(message.data), schema.data))
    return found


def at(table: TopicTable, time_ns: int, *names: str) -> list[float]:
    """Values of a table at a message's time."""
    k = int(np.flatnonzero(table.time_ns == time_ns)[0])
    return [float(table.columns[name][k]) for name in names]


def test_every_message_is_as_its_schema_says(log):
    for told in messages(log).values():
        assert told
        validator = jsonschema.Draft202012Validator(json.loads(told[0][2]))
        for _, message, _ in told[:20]:
            validator.validate(message)


def test_the_pose_is_the_angles_and_the_ghost_the_reference(log):
    """The beam's axis in space is e_ξ of the model's sign conventions, at every pose."""
    state, reference = (read_log(log).table(topic) for topic in ("/plant/state", "/reference"))
    found = messages(log)["/tf"]
    assert len(found) == 50
    for time_ns, message, _ in found:
        yaw, pitch = at(state, time_ns, "alpha_h", "alpha_v")
        rotation, _ = frames_of(message)["beam"]
        along = [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)]
        np.testing.assert_allclose(rotation[:, 0], along, atol=1e-6)
        np.testing.assert_allclose(rotation[:, 1], [-np.sin(yaw), np.cos(yaw), 0], atol=1e-6)
        assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-5)
    rotation, _ = frames_of(message)["reference_beam"]
    shown = [np.arctan2(rotation[1, 0], rotation[0, 0]), np.arcsin(rotation[2, 0])]
    assert shown == pytest.approx(at(reference, time_ns, "alpha_h", "alpha_v"), abs=1e-5)


def test_positive_pitch_raises_the_main_rotor(log):
    """From the hanging rest upwards: the rotor's place, with all frames composed."""
    found = messages(log)
    bodies = found["/scene"][0][1]
    beam = next(entity for entity in bodies["entities"] if entity["id"] == "beam")
    motor = max(beam["cylinders"], key=lambda part: part["pose"]["position"]["x"])
    place = np.array([motor["pose"]["position"][axis] for axis in "xyz"])
    assert place[0] == pytest.approx(0.246)  # l_m of the set `bench`
    heights, pitches = [], []
    state = read_log(log).table("/plant/state")
    for time_ns, message, _ in found["/tf"]:
        rotation, origin = frames_of(message)["beam"]
        heights.append(float((rotation @ place + origin)[2]))
        pitches += at(state, time_ns, "alpha_v")
    pivot = frames_of(found["/tf"][0][1])["yaw"][1][2]
    np.testing.assert_allclose(heights, pivot + 0.246 * np.sin(pitches), atol=1e-6)


def test_arrows_are_the_commands(log):
    command = read_log(log).table("/command")
    seen = 0
    for time_ns, message, _ in messages(log)["/scene/commands"]:
        share = at(command, time_ns, "u_v")[0] / 2.5
        arrows = message["entities"][0]["arrows"]
        main_rotor = [a for a in arrows if a["pose"]["position"]["x"] > 0]
        if abs(share) < 1e-6:
            continue
        length = main_rotor[0]["shaft_length"] + main_rotor[0]["head_length"]
        assert length == pytest.approx(abs(share) * 0.246, rel=1e-4)
        # x of the arrow, turned: up for a positive command
        turned = main_rotor[0]["pose"]["orientation"]
        up = 2 * (turned["x"] * turned["z"] - turned["w"] * turned["y"])
        assert up == pytest.approx(np.sign(share), abs=1e-6)
        seen += 1
    assert seen > 10


def test_readers_of_samples_pass_the_view_by(log, tmp_path):
    """Everything a reader sees is as in a run without the view."""
    without = run(tmp_path / "without", "sim.scene_every=0")
    one, other = read_log(log), read_log(without)
    assert list(one.tables) == list(other.tables)
    assert not set(SCENE_TOPICS) & set(one.tables)
    assert one.complete and one.duration_s == other.duration_s
    for topic in ("/command", "/plant/state", "/estimate", "/measurement"):
        for name, column in one.tables[topic].columns.items():
            np.testing.assert_array_equal(column, other.tables[topic].columns[name])
    with LogTail(log) as tail:
        piece = tail.read()
        assert piece is not None and not set(SCENE_TOPICS) & set(piece.tables)
        assert tail.problems == []
    for format_ in ("csv", "parquet", "mat"):
        export_log(one, tmp_path / f"view.{format_}", format_)
    export_log(other, tmp_path / "none.csv", "csv")
    told = [(tmp_path / name).read_text(encoding="utf-8") for name in ("view.csv", "none.csv")]
    samples = [[line for line in text.splitlines() if not line.startswith("#")] for text in told]
    assert samples[0] == samples[1]


def test_an_added_view_is_that_of_the_run(log):
    """What `trms export` adds is bit for bit what the run would have logged."""
    read = read_log(log)
    scene = scene_of_log(read)
    added: dict[str, list] = {topic: [] for topic in SCENE_TOPICS}
    for topic, time_ns, data in scene_messages(read, scene.encoder, scene.sources, 2):
        added[topic].append((time_ns, json.loads(data)))
    logged = messages(log)
    for topic in SCENE_TOPICS:
        assert added[topic] == [(time_ns, message) for time_ns, message, _ in logged[topic]], topic


def test_the_exported_log_holds_all_that_the_run_logged(log, tmp_path, capsys):
    out = tmp_path / "shown.mcap"
    assert main(["export", str(log), "--format", "foxglove", "--out", str(out)]) == 0
    assert "poses" in capsys.readouterr().out
    one, other = read_log(log), read_log(out)
    assert other.complete and other.run == one.run and other.score == one.score
    assert other.attachments == one.attachments
    for topic, table in one.tables.items():
        np.testing.assert_array_equal(table.time_ns, other.tables[topic].time_ns)
    assert len(messages(out)["/tf"]) == 50
    assert main(["export", str(log), "--format", "foxglove", "--out", str(out)]) == 2


def test_a_log_of_a_run_that_died_gains_a_view(log, tmp_path, capsys):
    cut = tmp_path / "cut.mcap"
    data = log.read_bytes()
    cut.write_bytes(data[: int(0.8 * len(data))])
    assert main(["export", str(cut), "--format", "foxglove"]) == 0
    assert "was not finished" in capsys.readouterr().out
    assert len(messages(tmp_path / "cut.foxglove.mcap")["/tf"]) >= 20


@pytest.mark.parametrize(
    ("words", "moves"),
    [
        (("model=newtonian_vertical", "controller=pid", "observer=full_state"), "alpha_v"),
        (("model=newtonian_horizontal", "controller=pid", "observer=full_state"), "alpha_h"),
        (("experiment=quanser_aero",), "alpha_v"),
        (("model=tras", "controller=open_loop", "observer=full_state"), "alpha_v"),
        (("model=narx_2dof", "controller=open_loop", "observer=full_state"), "alpha_v"),
    ],
)
@pytest.mark.slow
def test_every_rig_with_an_attitude_has_a_view(tmp_path, words, moves):
    path = run(tmp_path / "there", *words)
    found = messages(path)
    assert len(found["/scene"]) == 1 and len(found["/tf"]) > 5
    time_ns, message, _ = found["/tf"][-1]
    [angle] = at(read_log(path).table("/plant/state"), time_ns, moves)
    rotation, _ = frames_of(message)["beam"]
    told = np.arcsin(rotation[2, 0]) if moves == "alpha_v" else np.arctan2(*rotation[1::-1, 0])
    assert told == pytest.approx((angle + np.pi) % (2 * np.pi) - np.pi, abs=1e-5)


def test_a_motor_alone_has_none_and_says_why(tmp_path, capsys):
    words = ("model=motor_main", "ref=speed", "controller=open_loop", "observer=full_state")
    path = run(tmp_path / "motor", *words)
    assert messages(path) == {topic: [] for topic in SCENE_TOPICS}
    capsys.readouterr()
    assert main(["export", str(path), "--format", "foxglove"]) == 2
    assert "has no attitude" in capsys.readouterr().err


class TestLayout:
    """Each message path of the layout leads to something in a real log."""

    def test_every_path_resolves(self, log):
        paths = []
        for name, panel in json.loads(layout())["configById"].items():
            paths += [path["value"] for path in panel.get("paths", ())]
            paths += [panel[key] for key in ("topicPath", "topicToRender") if panel.get(key)]
            if name.startswith("3D!"):
                paths += list(panel["topics"])
        assert len(paths) > 15
        fields = {topic: set(table.columns) for topic, table in read_log(log).tables.items()}
        viewed = messages(log)
        for path in paths:
            topic, _, field = path.partition(".")
            if topic in viewed:
                assert viewed[topic] and not field
            else:
                assert topic in fields, path
                assert not field or field in fields[topic], path

    def test_every_panel_stands_once(self):
        told = json.loads(layout())

        def leaves(node) -> list[str]:
            if isinstance(node, str):
                return [node]
            assert set(node) == {"direction", "first", "second", "splitPercentage"}
            assert node["direction"] in ("row", "column") and 0 < node["splitPercentage"] < 100
            return leaves(node["first"]) + leaves(node["second"])

        assert sorted(leaves(told["layout"])) == sorted(told["configById"])

    def test_the_one_in_the_pages_is_the_one_that_is_written(self, tmp_path):
        out = tmp_path / "layout.json"
        assert main(["export", "--layout", str(out)]) == 0
        assert out.read_bytes() == (ROOT / "docs" / "foxglove" / "trms.json").read_bytes()
