"""YAML into pydantic models, with errors in the words of the one who wrote the file."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, get_args

import yaml
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

Location = tuple[int | str, ...]

_PASSWORD_KEYS = frozenset({"password", "passwd", "passwort", "passphrase", "pass", "pwd"})
_CLEAR_PASSWORD = (
    "a password must not stand in a configuration file; name the environment variable that holds "
    "it with password_env, or a file with password_file"
)
_LONGEST_SHOWN = 60


class ConfigError(ValueError):
    """A configuration cannot be used; the message says where, why and what is allowed."""


class _Loader(yaml.SafeLoader):
    """Refuses a key that is given twice, where YAML would silently keep the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if key.value in seen:
                    raise yaml.MarkedYAMLError(
                        problem=f"the key {key.value} is given twice", problem_mark=key.start_mark
                    )
                seen.add(key.value)
        return super().construct_mapping(node, deep)


def read_yaml(path: str | Path) -> object:
    """What a YAML file says.

    Raises:
        ConfigError: missing, not readable, not YAML; names the file and the line, but quotes
            nothing of it: there may be a secret in that line.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be read ({error.strerror or error}); check the path"
        ) from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is not a text file in UTF-8") from None
    try:
        # A safe loader, whatever the name of the function says.
        return yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None else f", line {mark.line + 1}, column {mark.column + 1}"
        problem = re.sub(r"'[^']{2,}'", "...", getattr(error, "problem", None) or "not YAML")
        # "from None": the original quotes the line.
        raise ConfigError(f"{path}{where}: {problem}") from None


def merged(base: object, override: object, alternatives: Iterable[frozenset[str]] = ()) -> object:
    """``override`` laid over ``base``, mapping by mapping.

    alternatives: sets of keys of which a mapping takes one: an overriding one drops the others.
    """
    if not (isinstance(base, dict) and isinstance(override, dict)):
        return override
    alternatives = tuple(alternatives)
    dropped = {key for group in alternatives if group & override.keys() for key in group}
    result = {key: value for key, value in base.items() if key not in dropped}
    for key, value in override.items():
        result[key] = merged(result[key], value, alternatives) if key in result else value
    return result


def explain(
    error: ValidationError,
    model: type[BaseModel],
    place: Callable[[Location], str],
    more_keys: tuple[str, ...] = (),
) -> str:
    """All that a validation found, in one line.

    model: what was validated. place: the user's name for a location. more_keys: keys of the top
    level that the model does not have.
    """
    found = []
    for one in error.errors(include_url=False):
        text = f"{place(one['loc'])}: {_problem(one, model, more_keys)}"
        if text not in found:
            found.append(text)
    return "; ".join(found)


def path_text(location: Location) -> str:
    """``cameras[2].feature.tilt_deg``."""
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f".{part}"
    return text.removeprefix(".")


def has_path(data: object, location: Location) -> bool:
    """Whether nested mappings and lists have something at a location."""
    for part in location:
        in_list = isinstance(data, list) and isinstance(part, int) and part < len(data)
        if not in_list and not (isinstance(data, dict) and part in data):
            return False
        data = data[part]
    return True


def nearest(word: str, known: Iterable[str]) -> str:
    """ "; did you mean ...?" where a known word is near, else nothing."""
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f"; did you mean {close[0]}?" if close else ""


def _problem(error: dict[str, Any], model: type[BaseModel], more_keys: tuple[str, ...]) -> str:
    location, kind = error["loc"], error["type"]
    if kind == "extra_forbidden":
        key = str(location[-1])
        if key.lower() in _PASSWORD_KEYS:
            return _CLEAR_PASSWORD
        owner = _model_at(model, location[:-1])
        known = [*owner.model_fields] if owner else []
        known += more_keys if len(location) == 1 else ()
        return f"there is no such setting{nearest(key, known)} (known here: {', '.join(known)})"
    if kind in ("model_type", "model_attributes_type"):
        owner = _model_at(model, location)
        keys = f" ({', '.join(owner.model_fields)})" if owner else ""
        return f"must be a mapping of settings{keys}"
    field = _field_at(model, location)
    about = f" ({field.description})" if field is not None and field.description else ""
    if kind == "missing":
        return f"is missing{about}"
    if kind == "value_error":  # written here, and complete
        return error["msg"].removeprefix("Value error, ")
    text = error["msg"].replace("Input should", "must")
    return text + _allowed(field, text) + _shown(error) + about


def _allowed(field: FieldInfo | None, text: str) -> str:
    """The bounds of a number, where the message does not give them all."""
    if field is None:
        return ""
    bounds = []
    for name, sign in (("ge", ">="), ("gt", ">"), ("le", "<="), ("lt", "<")):
        for rule in field.metadata:
            if (value := getattr(rule, name, None)) is not None:
                bounds.append(f"{sign} {value:g}")
    if not bounds or (len(bounds) == 1 and "than" in text):
        return ""
    return f"; allowed: {' and '.join(bounds)}"


def _shown(error: dict[str, Any]) -> str:
    """What was given, unless it is a structure or may be a secret."""
    given = error["input"]
    if "credentials" in error["loc"]:
        return ""
    if isinstance(given, dict | list):
        return f", not a {'mapping' if isinstance(given, dict) else 'list'}"
    shown = repr(given)
    return f", not {shown if len(shown) <= _LONGEST_SHOWN else shown[:_LONGEST_SHOWN] + '...'}"


def _field_at(model: type[BaseModel], location: Location) -> FieldInfo | None:
    names = [part for part in location if isinstance(part, str)]
    owner = _model_at(model, tuple(names[:-1]))
    return owner.model_fields.get(names[-1]) if owner and names else None


def _model_at(model: type[BaseModel], location: Location) -> type[BaseModel] | None:
    for part in location:
        if isinstance(part, str):
            field = model.model_fields.get(part)
            model = None if field is None else _model_in(field.annotation)
            if model is None:
                return None
    return model


def _model_in(annotation: object) -> type[BaseModel] | None:
    """The model inside of ``Model``, ``Model | None`` or ``list[Model]``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((m for m in map(_model_in, get_args(annotation)) if m is not None), None)
