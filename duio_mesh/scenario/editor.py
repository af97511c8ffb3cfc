"""The form of a topology file as a JSON schema, for editors that complete and check while one types."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core.core_schema import ModelSchema

from duio_mesh.scenario.schema import Topology


def editor_schema(options_by_method: Mapping[str, type[BaseModel]]) -> dict[str, Any]:
    """JSON schema (2020-12) of a topology; a plant file is its ``$defs/Plant``.

    It knows keys and types; what needs the whole file (shapes, names of inputs, node ids) only loading can tell.
    """
    schema = Topology.model_json_schema(schema_generator=_Documented)
    observers = []
    for method, options in options_by_method.items():
        own = options.model_json_schema(ref_template=f"#/$defs/{method}.{{model}}", schema_generator=_Documented)
        schema["$defs"] |= {f"{method}.{name}": inner for name, inner in own.pop("$defs", {}).items()}
        own["properties"] = {"method": {"const": method}, **own.get("properties", {})}
        own["required"] = ["method", *own.get("required", ())]
        observers.append(own)
    schema["properties"]["observer"] = {"oneOf": observers}
    schema["properties"]["nodes"]["propertyNames"] = {"pattern": "^[1-9][0-9]*$"}
    return {"$schema": GenerateJsonSchema.schema_dialect, "title": "duio_mesh topology"} | schema


class _Documented(GenerateJsonSchema):
    """The text below a field becomes its description; titles, which only repeat the key, are left out."""

    def model_schema(self, schema: ModelSchema) -> JsonSchemaValue:
        described = super().model_schema(schema)
        described.pop("title", None)
        for model in reversed(schema["cls"].__mro__):
            for name, text in _field_docs(model).items():
                described["properties"][name].setdefault("description", text)
        return described

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def _field_docs(model: type[Any]) -> dict[str, str]:
    """The strings that stand below the fields of a class."""
    if not issubclass(model, BaseModel) or not model.__module__.startswith("duio_mesh."):
        return {}
    body = ast.parse(textwrap.dedent(inspect.getsource(model))).body[0]
    docs = {}
    for field, text in pairwise(getattr(body, "body", ())):
        below = isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant) and text.value.value
        if below and isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            docs[field.target.id] = inspect.cleandoc(str(below))
    return docs
