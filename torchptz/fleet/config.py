"""Configuration of a fleet: which cameras, how to reach them, what to scan."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field, ValidationError, field_validator, model_validator
from pydantic_core.core_schema import ValidationInfo

from torchptz.cameras import DIALECTS, Credentials, dialect_options, open_camera
from torchptz.cameras.http.wire import parse_address
from torchptz.files import write_whole
from torchptz.fleet.config_sections import (
    CredentialsConfig,
    FeatureConfig,
    HeadConfig,
    ScanConfig,
    Section,
    TimingConfig,
    TlsConfig,
)
from torchptz.fleet.yaml_config import (
    ConfigError,
    Location,
    explain,
    has_path,
    merged,
    nearest,
    path_text,
    read_yaml,
)

__all__ = [
    "CameraConfig",
    "ConfigError",
    "CredentialsConfig",
    "FeatureConfig",
    "FleetConfig",
    "HeadConfig",
    "ScanConfig",
    "TimingConfig",
    "TlsConfig",
    "check_name",
    "load_config",
    "parse_config",
]

_NAME = re.compile(r"\w[\w.-]{0,63}")
_ONE_CAMERA_ONLY = ("name", "address")
_OF_THE_HEAD = ("tilt_zero_sigma_deg", "boresight_sigma_deg")
# One source of the password replaces the other, where a camera overrides the defaults.
_ALTERNATIVES = (
    frozenset({"password_env", "password_file"}),
    frozenset({"ca_file", "fingerprint", "verify"}),
)
_FILES = (("credentials", "password_file"), ("tls", "ca_file"))  # relative to the configuration


def check_name(name: str) -> str:
    """The name, if it can be the name of a folder on any system.

    Raises:
        ValueError: says what a name may consist of.
    """
    if not _NAME.fullmatch(name) or name.endswith((".", ".json", ".yaml")):
        raise ValueError(
            f"{name!r} cannot name a folder: use letters, digits, '_', '-' and '.', at most 64, "
            "not beginning with '-' or '.' and not ending in '.', '.json' or '.yaml'"
        )
    return name


class CameraConfig(Section):
    """One camera."""

    name: str = Field(description="unique; names the camera's folder")
    dialect: str = Field(description=f"what the camera speaks: {', '.join(sorted(DIALECTS))}")
    address: str = Field(description="host or host:port")
    credentials: CredentialsConfig | None = Field(None, description="null: no login")
    feature: FeatureConfig = FeatureConfig()
    zooms: list[Annotated[float, Field(ge=1, le=1000)]] = Field(
        min_length=1, description="nominal magnifications >= 1, ascending; 1 = widest"
    )
    pixel_aspect: float = Field(1.0, gt=0.5, lt=2, description="width over height of a pixel")
    pan_sign: Literal[1, -1] | None = Field(
        None, description="-1: the pan axis runs the other way; null: pictures tell"
    )
    tilt_sign: Literal[1, -1] | None = Field(
        None, description="-1: the tilt axis runs the other way; null: pictures tell"
    )
    tls: TlsConfig | None = Field(None, description="https; null: no encryption")
    device: dict[str, Any] = Field({}, description="options of the dialect's driver")
    head: HeadConfig = HeadConfig()
    scan: ScanConfig = ScanConfig()
    timing: TimingConfig = TimingConfig()

    @model_validator(mode="before")
    @classmethod
    def _head_in_one_place(cls, data: object) -> object:
        """Two of the head's settings may stand beside its section, as they once had to."""
        if not isinstance(data, dict):
            return data
        outside = {key: data[key] for key in _OF_THE_HEAD if key in data}
        head = data.get("head", {})
        if not outside or not isinstance(head, dict):
            return data
        for key in outside:
            if key in head:
                raise ValueError(f"{key} is given twice; give head.{key} alone")
        rest = {key: value for key, value in data.items() if key not in outside}
        return {**rest, "head": {**head, **outside}}

    @field_validator("name")
    @classmethod
    def _folder_name(cls, value: str) -> str:
        return check_name(value)

    @field_validator("dialect")
    @classmethod
    def _known_dialect(cls, value: str) -> str:
        if value not in DIALECTS:
            known = sorted(DIALECTS)
            raise ValueError(
                f"must be one of {', '.join(known)}, not {value!r}{nearest(value, known)}"
            )
        return value

    @field_validator("address")
    @classmethod
    def _host_and_port(cls, value: str, info: ValidationInfo) -> str:
        name = info.data.get("name", "?")
        try:
            parse_address(name, value)
        except ValueError as error:
            raise ValueError(str(error).removeprefix(f"camera {name}: ")) from None
        return value

    @field_validator("pan_sign", "tilt_sign", mode="before")
    @classmethod
    def _no_truth_value(cls, value: object) -> object:
        # Python takes True for 1, and YAML takes yes for True.
        if isinstance(value, bool):
            raise ValueError(f"must be 1 or -1, not {value}")
        return value

    @model_validator(mode="after")
    def _known_options(self) -> CameraConfig:
        known = dialect_options(self.dialect)
        for option in self.device:
            if option not in known:
                has = f"its options are: {', '.join(known)}" if known else "it has none"
                raise ValueError(
                    f"device.{option}: dialect {self.dialect} has no such option"
                    f"{nearest(option, known)}; {has}"
                )
        # The driver knows what its options may be; it sends nothing before it is asked to.
        try:
            options = self.driver_options()
            open_camera(self.dialect, self.name, self.address, None, **options).close()
        except (TypeError, ValueError) as error:
            text = str(error).removeprefix(f"camera {self.name}: ")
            raise ValueError(f"device: {text}") from None
        return self

    @field_validator("zooms")
    @classmethod
    def _ascending(cls, value: list[float]) -> list[float]:
        if any(after <= before for before, after in itertools.pairwise(value)):
            raise ValueError(f"must be ascending and different, not {value}")
        return value

    def resolve_credentials(self) -> Credentials | None:
        """The account to log in with, or None for none; see `CredentialsConfig.resolve`."""
        return None if self.credentials is None else self.credentials.resolve(self.name)

    def driver_options(self) -> dict[str, Any]:
        """What `open_camera` takes beside dialect, name, address and credentials."""
        return {
            **self.device,
            "tls": None if self.tls is None else self.tls.resolve(),
            "pan_sign": self.pan_sign,
            "tilt_sign": self.tilt_sign,
            "connect_timeout_s": self.timing.connect_timeout_s,
            "read_timeout_s": self.timing.read_timeout_s,
        }


class FleetConfig(Section):
    """A fleet of cameras, defaults already applied."""

    cameras: list[CameraConfig] = Field(min_length=1, description="the cameras of the fleet")

    @model_validator(mode="after")
    def _distinct(self) -> FleetConfig:
        names: dict[str, int] = {}
        addresses: dict[str, int] = {}
        for i, camera in enumerate(self.cameras):
            # Folders of some systems do not tell capitals from small letters.
            other = names.setdefault(camera.name.lower(), i)
            if other != i:
                raise ValueError(
                    f"cameras[{i}].name: {camera.name} is the name of cameras[{other}] too; "
                    "names must be unique (capitals do not count)"
                )
            usual_port = 80 if camera.tls is None else 443
            address = parse_address(camera.name, camera.address, usual_port).lower()
            other = addresses.setdefault(address, i)
            if other != i:
                raise ValueError(
                    f"cameras[{i}].address: {camera.address} belongs to camera "
                    f"{self.cameras[other].name} already; a head cannot serve two scans"
                )
        return self

    def save(self, path: str | Path) -> None:
        """Write the configuration as YAML that `load_config` reads.

        It holds where each password comes from, as the configuration did, and no password.
        """
        text = yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
        write_whole(path, text)


def load_config(path: str | Path) -> FleetConfig:
    """Read a fleet's configuration from YAML.

    Raises:
        ConfigError: names the file, the setting, what is wrong with it and what is allowed.
    """
    return parse_config(read_yaml(path), where=str(path), folder=Path(path).parent)


def parse_config(
    data: object, where: str = "fleet configuration", folder: str | Path | None = None
) -> FleetConfig:
    """A fleet's configuration from plain data; ``defaults`` are laid under every camera.

    where: what messages call the data. folder: where relative password files are.

    Raises:
        ConfigError: as `load_config`.
    """
    if not isinstance(data, dict):
        raise ConfigError(f"{where}: must be a mapping with the key cameras (and defaults)")
    data = dict(data)
    defaults = data.pop("defaults", None)
    defaults = {} if defaults is None else defaults
    if not isinstance(defaults, dict):
        raise ConfigError(f"{where}: defaults: must be a mapping of settings of a camera")
    for key in _ONE_CAMERA_ONLY:
        if key in defaults:
            raise ConfigError(f"{where}: defaults.{key}: belongs to each camera, not to defaults")
    own = data.get("cameras")
    if isinstance(own, list):
        data["cameras"] = [_complete(defaults, one, folder) for one in own]

    def place(location: Location) -> str:
        if len(location) < 2 or location[0] != "cameras" or not isinstance(own, list):
            return path_text(location) or "fleet"
        index, inside = location[1], location[2:]
        if not has_path(own[index], inside) and has_path(defaults, inside):
            return path_text(("defaults", *inside))
        name = own[index].get("name") if isinstance(own[index], dict) else None
        return path_text(location) + (f" (camera {name})" if isinstance(name, str) else "")

    try:
        return FleetConfig.model_validate(data)
    except ValidationError as error:
        text = explain(error, FleetConfig, place, more_keys=("defaults",))
    # Outside of the handler: the validation error quotes its input, secrets included.
    raise ConfigError(f"{where}: {text.removeprefix('fleet: ')}")


def _complete(defaults: dict, camera: object, folder: str | Path | None) -> object:
    camera = merged(defaults, camera, _ALTERNATIVES)
    if folder is None or not isinstance(camera, dict):
        return camera
    for section, key in _FILES:
        inside = camera.get(section)
        file = inside.get(key) if isinstance(inside, dict) else None
        if isinstance(file, str):
            path = Path(folder).resolve() / Path(file).expanduser()
            camera = {**camera, section: {**inside, key: str(path)}}
    return camera
