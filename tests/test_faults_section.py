"""The section of faults: that every switch has its run, and what is called right and wrong."""

import math
import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from torchptz.fleet.summary import CameraResult, ZoomResult
from torchptz.simulation import SimulationConfig
from torchptz.simulation.faults import FaultConfig

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"
sys.path.insert(0, str(SCRIPTS))
try:  # as a script imports them, from its folder
    from demo_check import FleetFigures, LensFigures, Standardised
    from faults import runs
    from faults.catalogue import CASES, Case
finally:
    sys.path.remove(str(SCRIPTS))

HEALTHY, SLOWED = Case({}, "axis", name="nothing"), Case({"slow_reply_s": 0.02}, "axis")
ZOOM = ZoomResult(1.0, 1.0, 0.0, True, "OK")


class TestCatalogue:
    def test_every_switch_has_a_run(self):
        assert {name for case in CASES for name in case.faults} == {*FaultConfig.model_fields}

    def test_there_are_more_than_25_switches(self):
        assert len(FaultConfig.model_fields) >= 25

    @pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.title}-{case.dialect}")
    def test_every_case_is_one_that_the_simulator_takes(self, case):
        FaultConfig.model_validate(case.faults)
        assert case.table or case.refusals != Case({}).refusals

    def test_titles_tell_the_cases_apart(self):
        titles = [(case.title, case.dialect) for case in CASES]
        assert len(set(titles)) == len(titles)

    def test_nothing_wrong_comes_before_what_is_compared_with_it(self):
        first = {}
        for case in CASES:
            if case.must_not_matter:
                first.setdefault(case.dialect, case)
        assert len(first) == 6
        assert all(case.title == "nothing" for case in first.values())

    def test_nothing_wrong_is_no_reason_to_refuse(self):
        cases = [case for case in CASES if case.refusals != Case({}).refusals]
        said = "worst error 1.1 sigma; sigma up to 1.82 px; camera one (127.0.0.1:80): answered"
        assert not [case.title for case in cases if re.search(case.refusals, said, re.IGNORECASE)]


class TestSettings:
    @staticmethod
    def simulated(case):
        return SimulationConfig.load({"cameras": [runs._simulated("one", case)]}).cameras[0]

    def test_a_case_changes_what_it_names_of_the_head_and_no_more(self):
        head = self.simulated(Case({}, simulated={"head": {"speed_up": 3.0}})).head
        assert (head.speed_up, head.reading_jitter) == (3.0, 0.3)

    def test_what_must_not_matter_has_the_lens_that_it_is_compared_with(self):
        alike = [self.simulated(case).seed for case in (HEALTHY, SLOWED)]
        other = self.simulated(replace(SLOWED, refusals="silent")).seed
        assert alike[0] == alike[1] != other

    def test_a_configuration_may_ask_the_served_fleet(self, tmp_path):
        case = Case({}, config=lambda fleet, name: {"tls": {"fingerprint": fleet[name][::-1]}})
        made = runs._configured("one", case, {"one": "abc"}, tmp_path)
        assert (made["address"], made["tls"]) == ("abc", {"fingerprint": "cba"})


class TestVerdicts:
    """A fleet of one camera, whose errors are made up."""

    @pytest.fixture
    def judge(self, monkeypatch, tmp_path):
        def judge(case, result, sigmas=1.0, rejected=0):
            errors = {"displacement": Standardised(sigmas, sigmas, 1)}
            lens = LensFigures("one", 1.0, "OK", True, standardised=errors)
            figures = FleetFigures([lens] if result and result.table else [], [])
            monkeypatch.setattr(runs, "fleet_figures", lambda *_: figures)
            return runs._judged(case, result, tmp_path, "one", {}, 3.0, rejected)

        return judge

    def test_a_true_table(self, judge):
        outcome = judge(Case({}), CameraResult((ZOOM,), "table.json", None))
        assert (outcome.verdict, outcome.right) == ("table", True)

    @pytest.mark.parametrize("sigmas", [4.1, math.inf])
    def test_a_table_that_is_not_as_true_as_it_says(self, judge, sigmas):
        outcome = judge(Case({}), CameraResult((ZOOM,), "table.json", None), sigmas)
        assert (outcome.verdict, outcome.right) == ("WRONG TABLE", False)

    def test_even_beside_an_error_a_table_must_be_true(self, judge):
        result = CameraResult((ZOOM,), "table.json", "camera one: cannot be reached")
        assert judge(Case({}, refusals="reached"), result, 9.0).verdict == "WRONG TABLE"
        assert judge(Case({}, refusals="reached"), result, 1.0).verdict == "refused"

    def test_a_table_where_none_may_be(self, judge):
        case = Case({"head_stuck": True}, table=False)
        outcome = judge(case, CameraResult((ZOOM,), "table.json", None))
        assert not outcome.right

    def test_a_refusal_for_another_reason(self, judge):
        result = CameraResult((), None, "camera one: unexpected KeyError: 'pan'")
        outcome = judge(Case({}, refusals="reached"), result)
        assert (outcome.verdict, outcome.right) == ("WRONG REASON", False)

    def test_a_zoom_that_failed_must_have_the_reason(self, judge):
        zoom = replace(ZOOM, ok=False, status="OUTLIERS")
        result = CameraResult((zoom,), None, None)
        assert judge(Case({}, refusals="OUTLIERS"), result).verdict == "refused"
        assert judge(Case({}, refusals="reached"), result).verdict == "WRONG REASON"

    def test_a_table_of_no_use(self):
        healthy = {}
        one = runs.Outcome("nothing", "axis", "table", "", 1.0, 0, 0.5)
        assert runs._useful(HEALTHY, one, healthy) == one
        for sigma, verdict in ((1.5, "table"), (1.6, "TABLE OF NO USE")):
            found = runs._useful(SLOWED, replace(one, sigma_px=sigma), healthy)
            assert (found.verdict, found.right) == (verdict, verdict == "table")
        wide = replace(one, sigma_px=9.0)
        assert runs._useful(replace(SLOWED, widens=True), wide, healthy) == wide
        assert runs._useful(replace(SLOWED, refusals="silent"), wide, healthy) == wide

    def test_what_never_ends(self, judge):
        assert judge(Case({}), None).verdict == "HANG"

    def test_logins(self, judge):
        result = CameraResult((), None, "camera one: refuses the credentials")
        case = Case({}, refusals="credentials", table=False, password="wrong")
        assert judge(case, result, rejected=1).right
        assert judge(case, result, rejected=2).verdict == "TOO MANY LOGINS"
        assert judge(replace(case, dialect="onvif"), result, rejected=2).right

    def test_rejected_logins_are_no_better_with_a_table(self, judge):
        result = CameraResult((ZOOM,), "table.json", None)
        assert judge(Case({}), result, rejected=1).verdict == "TOO MANY LOGINS"
        assert judge(Case({}, "onvif"), result, rejected=2).right
