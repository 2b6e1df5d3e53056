"""The dataclasses against the JSON Schemas that the program prints."""

from __future__ import annotations

import json
import subprocess
from dataclasses import MISSING, fields, is_dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import jsonschema
import pytest
from conftest import program
from test_codec import REPORT

import ecod
from ecod import codec, messages

# Names that differ; shares are among candidates only, maps of cells and their word on vehicles among cells.
CLASS_OF = {"WirePose": "Pose"}
LEFT_OUT = {"CellMap", "ClientRefusals", "LedgerShare"}


@pytest.fixture(scope="module")
def schemas() -> dict[str, Any]:
    printed = subprocess.run([program(), "schema"], check=True, capture_output=True, text=True).stdout
    found: dict[str, Any] = json.loads(printed)
    return found if "GlobalMap" in found else {schema["title"]: schema for schema in found.values()}


def check(kind: Any, schema: dict[str, Any], definitions: dict[str, Any], place: str, absent: bool = False) -> None:
    """Whether a field's type allows exactly what the schema does; `absent` is whether it may be left out."""
    if "$ref" in schema:
        schema = definitions[schema["$ref"].rpartition("/")[2]]
    options = schema.get("anyOf") or schema.get("oneOf") or []
    is_nullable = {"type": "null"} in options or "null" in schema.get("type", [])
    if get_origin(kind) is Union:
        kind = get_args(kind)[0]
        assert is_nullable, f"{place} is never null"
    else:
        assert not is_nullable, f"{place} may be null"
    if {"type": "null"} in options:
        return check(kind, next(option for option in options if option != {"type": "null"}), definitions, place)
    if get_origin(kind) is Annotated:
        kind = get_args(kind)[0]
    types = schema.get("type", "")
    name = types if isinstance(types, str) else next(word for word in types if word != "null")
    if get_origin(kind) is Literal:
        assert set(get_args(kind)) == {option["const"] for option in options}, place
    elif get_origin(kind) is list:
        assert name == "array" and "maxItems" not in schema, place
        check(get_args(kind)[0], schema["items"], definitions, f"{place}[]")
    elif get_origin(kind) is tuple:
        assert name == "array" and schema["minItems"] == schema["maxItems"] == len(get_args(kind)), place
        for part in get_args(kind):
            check(part, schema["items"], definitions, f"{place}[]")
    elif get_origin(kind) is dict:
        values = schema.get("additionalProperties") or next(iter(schema["patternProperties"].values()))
        check(get_args(kind)[1], values, definitions, f"{place}{{}}")
    elif is_dataclass(kind):
        check_class(kind, schema, definitions)
    else:
        assert name == {float: "number", int: "integer", str: "string", bool: "boolean"}[kind], place


def check_class(kind: Any, schema: dict[str, Any], definitions: dict[str, Any]) -> None:
    hints = get_type_hints(kind, include_extras=True)
    assert set(hints) == set(schema["properties"]), kind.__name__
    for field in fields(kind):
        place = f"{kind.__name__}.{field.name}"
        is_optional = get_origin(hints[field.name]) is Union
        has_default = field.default is not MISSING or field.default_factory is not MISSING
        assert (field.name in schema["required"]) == (not is_optional and not has_default), f"{place}: required or not"
        check(hints[field.name], schema["properties"][field.name], definitions, place)


def test_the_messages_have_the_fields_of_the_schemas(schemas: dict[str, Any]) -> None:
    assert "GlobalMap" in schemas and "ObjectReport" in schemas
    for title in schemas.keys() - LEFT_OUT:
        check_class(getattr(ecod, title), schemas[title], schemas[title]["$defs"])


def test_a_difference_is_noticed(schemas: dict[str, Any]) -> None:
    for spoil in (
        lambda map: map["properties"].update(weather={"type": "string"}),
        lambda map: map["properties"].pop("round"),
        lambda map: map["properties"]["round"].update(type="number"),
        lambda map: map["required"].remove("round"),
        lambda map: map["required"].append("oldest_capture_us"),
        lambda map: map["$defs"]["FusedObject"]["properties"]["covariance_m2"].update(minItems=2),
        lambda map: map["$defs"]["LandmarkState"]["properties"]["label"].update(type="string"),
    ):
        changed = json.loads(json.dumps(schemas["GlobalMap"]))
        spoil(changed)
        with pytest.raises(AssertionError):
            check_class(ecod.GlobalMap, changed, changed["$defs"])


def test_a_report_is_of_its_schema(schemas: dict[str, Any]) -> None:
    full = {
        "label": "car", "confidence": 0.9, "x_m": 1.0, "y_m": 2.0, "covariance_m2": (1.0, 0.0, 1.0), "landmark": "slot-0",
        "velocity_mps": (1.0, 2.0), "heading_rad": 0.1, "size_m": (4.0, 2.0), "scores": {"car": 0.9},
    }  # fmt: skip
    assert full.keys() == {field.name for field in fields(ecod.PerceivedObject)}
    report = ecod.ObjectReport(
        1, "euclid", 1, 2, [ecod.PerceivedObject(**full)], messages.Pose(0, 0, 0, 2.5, 0.3, 0.0), ["a"], ecod.FieldOfView(60, 6.2)  # type: ignore[arg-type]
    )
    for one in (report, REPORT):
        jsonschema.validate(json.loads(codec.encode(one)), schemas["ObjectReport"])
