"""Pydantic's verdict on a piece of a topology, in the user's words and at the place where the mistake stands.

Values are handed over as JSON under strict rules: a list may become a tuple, but no text or boolean a number.
"""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from duio_mesh.scenario.problems import Path, Problems, counted, did_you_mean, listed, nearest

M = TypeVar("M", bound=BaseModel)


def whole(model: type[M], value: Any, path: Path, problems: Problems) -> M | None:
    """The validated model, or None after reporting everything that is wrong with it."""
    try:
        return model.model_validate_json(json.dumps(value), strict=True)
    except ValidationError as e:
        _explain(e, model, value, path, problems)
        return None


def fields(model: type[BaseModel], value: Any, path: Path, problems: Problems) -> dict[str, Any]:
    """The model's fields by name; those that are wrong or missing are reported and left out.

    So that a wrong ``B`` does not hide a wrong ``C``: whoever needs both finds out that one is not there.
    """
    try:
        valid = model.model_validate_json(json.dumps(value), strict=True)
        return {name: getattr(valid, name) for name in model.model_fields}
    except ValidationError as e:
        misspelt = _explain(e, model, value, path, problems)
        wrong = {error["loc"][0] for error in e.errors() if error["loc"]}
    if not isinstance(value, Mapping):
        return {}
    found: dict[str, Any] = {}
    for name, info in model.model_fields.items():
        if name in value and name not in wrong:
            kind: Any = Annotated[(info.annotation, *info.metadata)] if info.metadata else info.annotation
            found[name] = TypeAdapter(kind).validate_json(json.dumps(value[name]), strict=True)
        elif name not in wrong and (name,) not in misspelt:
            found[name] = info.get_default(call_default_factory=True, validated_data={})
    return found


class _Fault(NamedTuple):
    """One of pydantic's errors; ``loc`` still names the branches of unions."""

    loc: Path
    type: str
    message: str
    context: Mapping[str, Any]


def _explain(error: ValidationError, model: type[BaseModel], value: Any, base: Path, problems: Problems) -> set[Path]:
    """Report every problem; returns the keys that are there, but misspelt: their absence is no second problem."""
    faults = [_Fault(e["loc"], e["type"], e["msg"], e.get("ctx", {})) for e in error.errors(include_url=False)]
    faults = _settle(faults, value)
    misspelt: set[Path] = set()
    for fault in faults:
        if fault.type == "extra_forbidden":
            *around, key = fault.loc
            known = _keys(_schema(model), _schema(model), tuple(around))
            meant = nearest(key, known)
            if meant is not None:
                misspelt.add((*around, meant))
            hint = did_you_mean(key, known) or f"; the keys here are {listed(sorted(known), 'and')}"
            problems.at_key((*base, *fault.loc), f"unknown key{hint}")
    for fault in faults:
        path = (*base, *fault.loc)
        if fault.type == "missing" and fault.loc not in misspelt:
            problems.at_key(path, "is missing")
        elif fault.context.get("at"):
            problems.at_key((*path, fault.context["at"]), fault.message)
        elif fault.type == "misfit" and problems.silenced_inside(path):
            continue  # the key that it asks for is there; the reader has rejected its value
        elif fault.type not in ("missing", "extra_forbidden"):
            problems.at(path, _words(fault, _reach(value, fault.loc)))
    return misspelt


@functools.cache
def _schema(model: type[BaseModel]) -> dict[str, Any]:
    return model.model_json_schema()


def _reach(value: Any, path: Path) -> Any:
    for part in path:
        value = value[part]
    return value


def _settle(faults: list[_Fault], value: Any) -> list[_Fault]:
    """One opinion per union: that of the branch which got furthest; every union's branch name is cut out of ``loc``."""
    settled: list[_Fault] = []
    unions: dict[Path, dict[str | int, list[_Fault]]] = {}
    for fault in faults:
        at = _branch(fault, value)
        if at is None:
            settled.append(fault)
        else:
            branches = unions.setdefault(fault.loc[:at], {})
            branches.setdefault(fault.loc[at], []).append(fault._replace(loc=(*fault.loc[:at], *fault.loc[at + 1 :])))
    for path, branches in unions.items():
        rooted = {name: _settle(found, value) for name, found in branches.items()}
        reach = {name: min(_reached(f, path) for f in found) for name, found in rooted.items()}
        if max(reach.values()) > 0:
            best = min(rooted, key=lambda name: (-reach[name], len(rooted[name])))
            settled += rooted[best]
        else:
            all_ = [fault for found in rooted.values() for fault in found]
            wanted = [word for fault in all_ for word in fault.context.get("wanted", (_wanted(fault),))]
            wanted = list(dict.fromkeys(wanted))
            settled.append(_Fault(path, "union", "", {"wanted": wanted}))
    return settled


def _reached(fault: _Fault, path: Path) -> int:
    """How far the branch got: 0 when already the kind of value was wrong."""
    depth = len(fault.loc) - len(path)
    return depth if depth or fault.type.endswith("_type") or fault.type in ("literal_error", "union") else 1


def _branch(fault: _Fault, value: Any) -> int | None:
    """Where in ``loc`` the first name of a union's branch stands: the first part that the value does not have."""
    last = len(fault.loc) - 1
    for k, part in enumerate(fault.loc):
        here = isinstance(value, Mapping) and part in value
        if here or (isinstance(value, list) and isinstance(part, int) and part < len(value)):
            value = value[part]
        elif k == last and fault.type == "missing":
            return None
        else:
            return k
    return None


def _keys(schema: Mapping[str, Any], root: Mapping[str, Any], path: Path) -> list[str]:
    """The keys that a JSON schema allows at ``path``."""
    if "$ref" in schema:
        return _keys(root["$defs"][schema["$ref"].rsplit("/", 1)[-1]], root, path)
    found: list[str] = []
    for choice in ("anyOf", "oneOf", "allOf"):
        for branch in schema.get(choice, ()):
            found += _keys(branch, root, path)
    if not path:
        return list(dict.fromkeys([*found, *schema.get("properties", ())]))
    head, *rest = path
    inner = schema.get("items") if isinstance(head, int) else schema.get("properties", {}).get(head)
    if inner is None and isinstance(schema.get("additionalProperties"), Mapping):
        inner = schema["additionalProperties"]
    return found + (_keys(inner, root, tuple(rest)) if isinstance(inner, Mapping) else [])


_KINDS = {
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "string_type": "text",
    "bool_type": "true or false",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "a mapping",
    "model_type": "a mapping",
    "model_attributes_type": "a mapping",
    "none_required": "null",
}
_LIMITS = {"greater_than": "gt", "greater_than_equal": "ge", "less_than": "lt", "less_than_equal": "le"}
_COMPARISONS = {"gt": "greater than", "ge": "at least", "lt": "less than", "le": "at most"}


def _wanted(fault: _Fault) -> str:
    """What stands after 'should be'."""
    if fault.type == "literal_error":
        return str(fault.context["expected"])
    if fault.type in _LIMITS:
        limit = _LIMITS[fault.type]
        return f"{_COMPARISONS[limit]} {fault.context[limit]:g}"
    return _KINDS.get(fault.type, "something else")


def _words(fault: _Fault, value: Any) -> str:
    if fault.type == "union":
        forms = listed([w for w in fault.context["wanted"] if w != "null"])
        return f"should be {forms}, not {describe(value)}{_nearest(value, forms)}"
    if fault.type in _KINDS or fault.type in _LIMITS or fault.type == "literal_error":
        wanted = _wanted(fault)
        return f"should be {wanted}, not {describe(value)}{_nearest(value, wanted)}"
    if fault.type in ("too_short", "too_long"):
        few = fault.type == "too_short"
        limit = fault.context["min_length" if few else "max_length"]
        return f"should have at {'least' if few else 'most'} {counted(limit, 'entry')}, not {len(value)}"
    if fault.type in ("string_too_short", "string_too_long", "string_pattern_mismatch"):
        return _text_rule(fault, value)
    return fault.message.removeprefix("Value error, ")


def _text_rule(fault: _Fault, value: str) -> str:
    if fault.type == "string_pattern_mismatch":
        return f"should begin with a letter or digit and have only these, '.', '_' and '-' in it, not {describe(value)}"
    if fault.type == "string_too_short":
        return "should not be empty"
    return f"should have at most {fault.context['max_length']} characters, not {len(value)}"


def _nearest(value: Any, wanted: str) -> str:
    """A hint when text was given where certain words are expected."""
    return did_you_mean(value, re.findall(r"'([^']*)'", wanted)) if isinstance(value, str) else ""


def describe(value: Any) -> str:
    """A value as the user sees it."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f"the text {value[:40]!r}" + ("..." if len(value) > 40 else "")
    if isinstance(value, Mapping):
        return "a mapping"
    return "a list" if isinstance(value, list) else f"{value!r}"
