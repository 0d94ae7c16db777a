"""Topics and the schemas that travel in the log."""

import pytest

from trms_cli.recordings.topics import Field, Topic, standard_topics


def test_absent_signals_make_no_topic():
    replayed = standard_topics(inputs=[Field("u_v", "V")], outputs=[Field("alpha_v", "rad")])
    names = [topic.name for topic in replayed]
    assert "/plant/state" not in names and "/reference" not in names
    assert names == ["/command", "/measurement", "/controller", "/event"]


def test_all_topics_of_the_file_contract(topics):
    assert {topic.name for topic in topics} == {
        "/reference",
        "/command",
        "/measurement",
        "/plant/state",
        "/estimate",
        "/controller",
        "/prediction",
        "/event",
    }
    estimate = next(topic for topic in topics if topic.name == "/estimate")
    assert set(estimate.field_names) == {
        *("omega_h", "alpha_h", "sd_omega_h", "sd_alpha_h"),
        *("predicted_alpha_v", "innovation_alpha_v", "innovation_sd_alpha_v"),
        *("predicted_alpha_h", "innovation_alpha_h", "innovation_sd_alpha_h"),
    }


def test_foxglove_accepts_the_schemas_and_units_stand_in_descriptions(topics):
    """Foxglove knows a subset of JSON schema: one type per property, typed array items."""
    for topic in topics:
        schema = topic.json_schema()
        assert schema["type"] == "object"
        assert schema["additionalProperties"] is False
        assert schema["title"] == topic.schema_name
        assert set(schema["required"]) == set(schema["properties"])
        for property_ in schema["properties"].values():
            assert property_["type"] in ("number", "integer", "string", "boolean", "array")
            if property_["type"] == "array":
                assert property_["items"]["type"] == "number"
        for field in topic.fields:
            text = field.json_schema()["description"]
            if field.kind in ("number", "integer", "array"):
                assert f"[{field.unit}]" in text


def test_a_field_named_twice_is_refused():
    with pytest.raises(ValueError, match="twice: x"):
        Topic("/t", (Field("x"), Field("x")))
