"""FleetConfig: what it accepts, what it says about what it does not, and what it never says."""

import math
import re
from pathlib import Path

import certifi
import pytest
import yaml

from torchptz.calibration import Priors
from torchptz.cameras import DIALECTS, Tls, dialect_options
from torchptz.fleet.config import (
    CameraConfig,
    ConfigError,
    FeatureConfig,
    FleetConfig,
    HeadConfig,
    ScanConfig,
    TimingConfig,
    load_config,
    parse_config,
)

CONFIGS = Path(__file__).parents[2] / "configs"
SECRET = "hunter2-Geheim"


def camera(name="gate", **settings) -> dict:
    address = f"192.0.2.{1 + sum(map(ord, str(name))) % 250}"
    return {"name": name, "dialect": "sony_rz30", "address": address, "zooms": [1, 4]} | settings


def refused(*cameras, **top) -> str:
    """What is said about a configuration that must be refused."""
    with pytest.raises(ConfigError) as caught:
        parse_config({"cameras": list(cameras), **top}, where="fleet.yaml")
    # A traceback must not tell either.
    assert caught.value.__cause__ is None
    assert caught.value.__context__ is None
    return str(caught.value)


class TestDefaults:
    def test_the_defaults_of_the_brief(self):
        one = parse_config({"cameras": [camera()]}).cameras[0]
        scan = one.scan
        assert (scan.horizontal, scan.vertical, scan.oblique) == (12, 10, 0)
        assert (scan.points_per_line, scan.tracks) == (20, 8)
        assert (one.pixel_aspect, one.pan_sign, one.tilt_sign) == (1.0, None, None)
        assert (scan.design, scan.target_sigma_px) == ("spread", 0.2)
        assert one.feature.kind == "ball"
        assert one.feature.direction() is None
        assert one.resolve_credentials() is None

    def test_they_lie_under_every_camera_and_each_may_override_one_number(self):
        config = parse_config(
            {
                "defaults": {"dialect": "sony_rz30", "zooms": [1, 2], "scan": {"vertical": 7}},
                "cameras": [
                    {"name": "a", "address": "a"},
                    {"name": "b", "address": "b", "zooms": [1], "scan": {"horizontal": 3}},
                ],
            }
        )
        a, b = config.cameras
        assert (a.zooms, a.scan.horizontal, a.scan.vertical) == ([1, 2], 12, 7)
        assert (b.zooms, b.scan.horizontal, b.scan.vertical) == ([1], 3, 7)

    def test_a_camera_s_source_of_the_password_replaces_the_default_one(self, tmp_path):
        (tmp_path / "gate.txt").write_text(SECRET + "\n")
        config = parse_config(
            {
                "defaults": {"credentials": {"user": "admin", "password_env": "NOT_SET_ANYWHERE"}},
                "cameras": [camera(credentials={"password_file": "gate.txt"})],
            },
            folder=tmp_path,
        )
        found = config.cameras[0].resolve_credentials()
        assert (found.user, found.password) == ("admin", SECRET)

    @pytest.mark.parametrize("key", ["name", "address"])
    def test_refuses_what_belongs_to_one_camera(self, key):
        assert f"defaults.{key}: belongs to each camera" in refused(camera(), defaults={key: "x"})

    def test_an_error_in_them_is_reported_once_and_there(self):
        text = refused(camera("a"), camera("b"), defaults={"scan": {"horizontl": 3}})
        assert text.count("horizontl") == 1
        assert text.startswith("fleet.yaml: defaults.scan.horizontl: ")


class TestHead:
    def test_the_defaults_are_those_of_the_calibration(self):
        head, priors = parse_config({"cameras": [camera()]}).cameras[0].head, Priors()
        for name in ("tilt_zero_sigma", "boresight_sigma", "roll_sigma", "backlash_sigma"):
            assert math.radians(getattr(head, f"{name}_deg")) == pytest.approx(
                getattr(priors, name)
            )
        assert (head.pupil_m, head.pupil_sigma_m) == (priors.pupil_m, priors.pupil_sigma_m)
        assert math.radians(head.repeatability_deg) == priors.repeatability

    def test_defaults_and_a_camera_share_the_section(self):
        config = parse_config(
            {
                "defaults": {"head": {"tilt_zero_sigma_deg": 0.3, "pupil_m": 0.02}},
                "cameras": [camera(head={"pupil_m": 0.04})],
            }
        )
        (one,) = config.cameras
        assert (one.head.tilt_zero_sigma_deg, one.head.pupil_m) == (0.3, 0.04)

    def test_two_of_its_settings_may_stand_beside_it(self, tmp_path):
        config = parse_config(
            {
                "defaults": {"tilt_zero_sigma_deg": 0.2},
                "cameras": [camera(boresight_sigma_deg=0.4, head={"roll_sigma_deg": 1})],
            }
        )
        head = config.cameras[0].head
        assert (head.tilt_zero_sigma_deg, head.boresight_sigma_deg) == (0.2, 0.4)
        assert head.roll_sigma_deg == 1.0
        config.save(tmp_path / "copy.yaml")
        assert load_config(tmp_path / "copy.yaml") == config

    def test_but_not_twice(self):
        text = refused(camera(boresight_sigma_deg=0.4, head={"boresight_sigma_deg": 0.4}))
        assert "given twice; give head.boresight_sigma_deg alone" in text


class TestDirectionsAndOptions:
    def test_degrees_become_radians(self):
        one = parse_config({"cameras": [camera(feature={"pan_deg": 90, "tilt_deg": -45})]})
        assert one.cameras[0].feature.direction() == pytest.approx((math.pi / 2, -math.pi / 4))

    def test_the_driver_takes_its_options(self):
        from torchptz.cameras import open_camera

        one = parse_config({"cameras": [camera(tilt_sign=-1)]}).cameras[0]
        driver = open_camera(one.dialect, one.name, one.address, None, **one.driver_options())
        plain = open_camera(one.dialect, one.name, one.address, None)
        low, high = plain.capabilities.tilt_limits
        assert driver.capabilities.tilt_limits == pytest.approx((-high, -low))


class TestTls:
    def test_a_fingerprint_is_taken_with_colons_or_without(self):
        tls = {"fingerprint": ":".join(["AB"] * 32)}
        one = parse_config({"cameras": [camera(tls=tls)]}).cameras[0]
        assert one.driver_options()["tls"] == Tls(fingerprint=tls["fingerprint"])

    def test_without_the_section_there_is_no_encryption(self):
        one = parse_config({"cameras": [camera()]}).cameras[0]
        assert one.driver_options()["tls"] is None

    def test_a_camera_that_pins_drops_the_defaults_authority(self, tmp_path):
        data = {
            "defaults": {"tls": {"ca_file": "ca.pem"}},
            "cameras": [camera(tls={"fingerprint": "cd" * 32}), camera("other", address="other")],
        }
        (tmp_path / "ca.pem").write_bytes(Path(certifi.where()).read_bytes())
        one, other = (c.tls for c in parse_config(data, folder=tmp_path).cameras)
        assert (one.ca_file, one.fingerprint) == (None, "cd" * 32)
        assert other.ca_file == str(tmp_path / "ca.pem")


class TestMessages:
    @pytest.mark.parametrize(
        ("settings", "words"),
        [
            ({"feature": {"pan_deg": 3, "tilt_degg": 1}}, ["feature.tilt_degg", "mean tilt_deg?"]),
            ({"feature": {"pan_deg": 3}}, ["feature (", "tilt_deg is missing", "both, or neither"]),
            ({"feature": {"pan_deg": 1, "tilt_deg": 95}}, [".feature.tilt_deg", "95", "<= 90"]),
            ({"feature": {"kind": "cube"}}, ["feature.kind", "'ball'", "'cube'"]),
            ({"feature": {"distance_m": 0}}, ["feature.distance_m", "greater than 0"]),
            ({"feature": {"distance_sigma_m": 1}}, ["distance_sigma_m goes with a distance_m"]),
            ({"head": {"rol_sigma_deg": 1}}, ["head.rol_sigma_deg", "mean roll_sigma_deg?"]),
            ({"head": {"pupil_sigma_m": -1}}, ["head.pupil_sigma_m", ">= 0", "-1"]),
            ({"tilt_zero_sigma_deg": 11}, ["head.tilt_zero_sigma_deg", "<= 10", "11"]),
            ({"head": 3}, ["head", "mapping", "roll_sigma_deg"]),
            ({"scan": {"design": "best"}}, ["scan.design", "'spread' or 'optimal'", "'best'"]),
            ({"scan": {"target_sigma_px": 0}}, ["scan.target_sigma_px", "greater than 0"]),
            ({"scan": {"most_views": 5}}, ["scan.most_views", ">= 20"]),
            ({"zooms": [2, 1]}, ["zooms", "ascending"]),
            ({"zooms": [1, 1]}, ["zooms", "ascending"]),
            ({"zooms": [0.5, 1]}, ["zooms[0]", "greater than or equal to 1", "0.5"]),
            ({"zooms": []}, ["zooms", "at least 1"]),
            ({"pan_sign": 2}, ["pan_sign", "1 or -1", "2"]),
            ({"pan_sign": True}, ["pan_sign", "1 or -1", "True"]),
            ({"device": {"fokus_wait_s": 2}}, ["device.fokus_wait_s", "mean focus_wait_s?"]),
            ({"device": {"pan_speed": 99}}, ["device: pan_speed must be 1..24"]),
            ({"tls": {"fingerprint": "12:34"}}, ["tls", "SHA-256", "64 hexadecimal"]),
            ({"tls": {"fingerprint": "ab" * 32, "verify": False}}, ["tls", "not several"]),
            ({"tls": {"fingerprint": "ab" * 32, "ca_file": "a"}}, ["tls", "not several"]),
            ({"scan": {"overshoot_deg": -1}}, ["scan.overshoot_deg", ">= 0"]),
            ({"pixel_aspect": math.nan}, ["pixel_aspect", "finite", "nan"]),
            ({"dialect": "sony_rz3"}, ["dialect", "sony_rz30", "did you mean sony_rz30?"]),
            ({"address": "http://host/"}, ["address", "host:port"]),
            ({"scan": {"tracks": 1}}, ["scan.tracks", ">= 2"]),
            ({"scan": {"vertical": True}}, ["scan.vertical", "integer", "True"]),
            ({"scan": {"horizontal": 1, "vertical": 1}}, ["scan (", "2 lines", "at least 3"]),
            ({"timing": {"poll_interval_s": 20}}, ["timing", "shorter than settle_timeout_s"]),
            ({"timing": 3}, ["timing", "mapping", "settle_timeout_s"]),
            ({"name": "../up"}, ["name", "cannot name a folder"]),
            ({"name": "summary.json"}, ["name", "cannot name a folder"]),
            ({"name": 3}, ["name", "string", "3"]),
        ],
    )
    def test_name_the_setting_the_fault_and_what_is_allowed(self, settings, words):
        text = refused(camera("first"), camera(**settings))
        assert text.startswith("fleet.yaml: cameras[1]")
        for word in words:
            assert word in text
        assert "\n" not in text

    def test_several_faults_are_all_named(self):
        text = refused(camera(zooms=[0.5]), {"name": "b"})
        for word in (
            "cameras[0].zooms[0]",
            "cameras[1].dialect",
            "cameras[1].address (camera b): is",
        ):
            assert word in text

    def test_names_and_addresses_must_differ(self):
        assert "cameras[1].name" in refused(camera("Gate"), camera("gate", address="other"))
        same = refused(camera("a", address="host"), camera("b", address="HOST:80"))
        assert "cameras[1].address" in same
        assert "belongs to camera a" in same

    @pytest.mark.parametrize("data", [None, [], "text", {"cameras": []}, {"cameras": 3}, {}])
    def test_what_is_no_fleet(self, data):
        with pytest.raises(ConfigError, match=r"^fleet.yaml: .*cameras"):
            parse_config(data, where="fleet.yaml")

    def test_a_typo_at_the_top(self):
        assert "camras: there is no such setting; did you mean cameras?" in refused(
            camera(), camras=[]
        )


class TestFile:
    def load(self, folder: Path, text: str) -> FleetConfig:
        (folder / "fleet.yaml").write_text(text)
        return load_config(folder / "fleet.yaml")

    def test_missing(self, tmp_path):
        with pytest.raises(ConfigError, match=r"nowhere.yaml: cannot be read \(No such file"):
            load_config(tmp_path / "nowhere.yaml")

    def test_not_yaml_names_the_line_and_quotes_nothing(self, tmp_path):
        with pytest.raises(ConfigError, match=r"fleet.yaml, line 2, column") as caught:
            self.load(tmp_path, f"cameras:\n  - user: admin: {SECRET}\n")
        assert SECRET not in str(caught.value)

    def test_a_key_given_twice(self, tmp_path):
        with pytest.raises(ConfigError, match=r"line 3.*zooms is given twice"):
            self.load(tmp_path, "defaults:\n  zooms: [1]\n  zooms: [1, 2]\n")

    def test_no_objects_are_made(self, tmp_path):
        with pytest.raises(ConfigError, match="line 1"):
            self.load(tmp_path, "cameras: !!python/object/apply:os.getcwd []\n")

    def test_saved_and_loaded_it_is_the_same(self, tmp_path):
        before = parse_config({"cameras": [camera(credentials={"user": "u", "password_env": "X"})]})
        before.save(tmp_path / "copy.yaml")
        assert load_config(tmp_path / "copy.yaml") == before


class TestCredentials:
    def resolve(self, **account):
        config = parse_config({"cameras": [camera(credentials={"user": "admin", **account})]})
        return config.cameras[0].resolve_credentials()

    def test_from_the_environment(self, monkeypatch):
        monkeypatch.setenv("GATE_PASSWORD", SECRET)
        found = self.resolve(password_env="GATE_PASSWORD")
        assert (found.user, found.password) == ("admin", SECRET)

    def test_without_a_source_the_password_is_empty(self):
        assert self.resolve().password == ""

    def test_a_variable_that_is_not_set(self, monkeypatch):
        monkeypatch.delenv("GATE_PASSWORD", raising=False)
        with pytest.raises(ConfigError, match=r"camera gate: .*GATE_PASSWORD is not set"):
            self.resolve(password_env="GATE_PASSWORD")

    @pytest.mark.parametrize("content", [None, b"", f"{SECRET}\n{SECRET}".encode(), b"\xff\xfe"])
    def test_a_file_that_holds_no_password(self, tmp_path, content):
        path = tmp_path / "gate.txt"
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(ConfigError, match=r"camera gate: the password file .*gate.txt") as got:
            self.resolve(password_file=str(path))
        assert SECRET not in str(got.value)
        assert got.value.__context__ is None

    def test_both_sources(self):
        account = {"user": "admin", "password_env": "A", "password_file": "b"}
        assert "not both" in refused(camera(credentials=account))


class TestSecrets:
    """A password put anywhere it may be put by mistake is not repeated."""

    @pytest.mark.parametrize(
        "settings",
        [
            {"credentials": {"user": "admin", "password": SECRET}},
            {"password": SECRET},
            {"credentials": {"user": "admin", "password_env": SECRET}},
            {"credentials": f"admin:{SECRET}"},
            {"credentials": {"user": ["admin", SECRET]}},
            {"address": f"admin:{SECRET}@192.0.2.1"},
        ],
    )
    def test_is_refused_and_not_quoted(self, settings):
        assert SECRET not in refused(camera(**settings))

    def test_a_clear_password_is_refused_with_the_way_out(self):
        text = refused(camera(credentials={"user": "admin", "password": SECRET}))
        assert "cameras[0].credentials.password" in text
        assert "password_env" in text

    def test_the_saved_copy_has_none(self, tmp_path, monkeypatch):
        monkeypatch.setenv("GATE_PASSWORD", SECRET)
        account = {"user": "admin", "password_env": "GATE_PASSWORD"}
        config = parse_config({"cameras": [camera(credentials=account)]})
        config.cameras[0].resolve_credentials()
        config.save(tmp_path / "copy.yaml")
        assert SECRET not in (tmp_path / "copy.yaml").read_text()


class TestShippedConfigurations:
    def test_every_fleet_loads(self):
        names = {path.name for path in CONFIGS.glob("*.yaml")} - {"simulated_fleet.yaml"}
        assert names == {"fleet.yaml", *(f"{dialect}.yaml" for dialect in DIALECTS)}
        for name in names:
            assert load_config(CONFIGS / name).cameras

    @pytest.mark.parametrize("dialect", DIALECTS)
    def test_an_example_shows_every_option_of_its_driver(self, dialect):
        """Options that are commented out count, and what they show must load."""
        text = (CONFIGS / f"{dialect}.yaml").read_text(encoding="utf-8")
        before, cameras, settings = text.partition("\ncameras:\n")
        settings = re.sub(r"(?m)^( *)# ( *\w+: )", r"\1\2", settings)
        settings = settings.replace("…", "ab" * 32)  # the fingerprint, which nobody can give here
        (one,) = parse_config(yaml.safe_load(before + cameras + settings)).cameras
        assert one.dialect == dialect
        assert sorted(one.device) == sorted(dialect_options(dialect))

    def test_the_example_that_explains_all_settings_has_them_all(self):
        data = yaml.safe_load((CONFIGS / "sony_rz30.yaml").read_text(encoding="utf-8"))
        shown = {**data["defaults"], **data["cameras"][0]}
        assert shown.keys() == CameraConfig.model_fields.keys()
        for section, model in (
            *(("scan", ScanConfig), ("timing", TimingConfig), ("head", HeadConfig)),
            ("feature", FeatureConfig),
        ):
            assert shown[section].keys() == model.model_fields.keys()

    def test_the_simulated_cameras_are_those_of_the_simulation(self):
        simulated = yaml.safe_load((CONFIGS / "simulated_fleet.yaml").read_text())["cameras"]
        config = load_config(CONFIGS / "fleet.yaml")
        assert {c.name: c.address for c in config.cameras} == {
            one["name"]: f"127.0.0.1:{one['port']}" for one in simulated
        }
        for one, truth in zip(config.cameras, simulated, strict=True):
            ball = truth["scene"]["ball"]
            assert one.feature.pan_deg == ball["pan_deg"]
            assert one.feature.tilt_deg == ball["tilt_deg"]
            off = abs(one.feature.distance_m - ball["distance_m"])
            assert off < 3 * one.feature.distance_sigma_m
            assert one.pixel_aspect == truth["head"].get("pixel_aspect", 1.0)
            assert one.credentials.user == truth.get("user", "admin")
