"""The schemas of Foxglove's messages mean what those of the published package mean."""

import json
from typing import Any

import pytest
from foxglove import messages as published
from google.protobuf import descriptor_pb2, descriptor_pool
from google.protobuf.descriptor import Descriptor, FieldDescriptor

from trms_cli.recordings.foxglove.types import FrameTransforms, Log, SceneUpdate, schema_text

#: JSON's kinds by those of protobuf; what is bytes there is base64 here.
_KINDS = {
    FieldDescriptor.TYPE_DOUBLE: "number",
    FieldDescriptor.TYPE_STRING: "string",
    FieldDescriptor.TYPE_BYTES: "string base64",
    FieldDescriptor.TYPE_BOOL: "boolean",
    FieldDescriptor.TYPE_FIXED32: "integer from 0",
    FieldDescriptor.TYPE_UINT32: "integer from 0",
    FieldDescriptor.TYPE_INT32: "integer",
    FieldDescriptor.TYPE_INT64: "integer",
}
_STAMPS = {"google.protobuf.Timestamp": "time", "google.protobuf.Duration": "duration"}


def meaning_of_published(name: str) -> Any:
    """A message of the package: fields in their order, with what each is, nested."""
    files = descriptor_pb2.FileDescriptorSet.FromString(getattr(published, name).get_schema().data)
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    return _of_descriptor(pool.FindMessageTypeByName(f"foxglove.{name}"))


def _of_descriptor(message: Descriptor) -> Any:
    if message.full_name in _STAMPS:
        return _STAMPS[message.full_name]
    fields = {}
    for field in message.fields:
        if field.message_type is not None:
            kind = _of_descriptor(field.message_type)
        elif field.enum_type is not None:
            kind = {value.name: value.number for value in field.enum_type.values}
        else:
            kind = _KINDS[field.type]
        fields[field.name] = [kind] if field.is_repeated else kind
    return message.full_name, fields


def meaning_of_ours(schema: dict[str, Any]) -> Any:
    if "oneOf" in schema:
        return {value["title"]: value["const"] for value in schema["oneOf"]}
    if schema["type"] == "array":
        return [meaning_of_ours(schema["items"])]
    if schema["type"] == "object":
        properties = schema["properties"]
        assert schema["required"] == list(properties)
        if schema["title"] in _STAMPS.values():
            assert list(properties) == ["sec", "nsec"]
            assert properties["nsec"] == {"type": "integer", "minimum": 0, "maximum": 999999999}
            return schema["title"]
        return schema["title"], {name: meaning_of_ours(of) for name, of in properties.items()}
    if schema.get("contentEncoding") == "base64":
        return "string base64"
    return schema["type"] + (" from 0" if schema.get("minimum") == 0 else "")


@pytest.mark.parametrize("message", [FrameTransforms, Log, SceneUpdate])
def test_a_schema_means_what_the_published_one_means(message: type) -> None:
    ours = json.loads(schema_text(message))
    assert ours["title"] == f"foxglove.{message.__name__}"
    assert meaning_of_ours(ours) == meaning_of_published(message.__name__)
