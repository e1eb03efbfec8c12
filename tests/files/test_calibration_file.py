# Copyright 2026 semcal_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The calibration file: full precision, atomic, and clear about what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml

from semcal_ros import Calibration, SemcalError
from semcal_ros.bridge.calibration import MAX_TEXT_BYTES
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.camera.calibration_model import FUNCTION_NAMES, TERM_NAMES
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.projection import ALL_NAMES, PARAMETER_NAMES
from semcal_ros.core.camera.records import Provenance
from semcal_ros.core.camera.residual_field import zero_field
from semcal_ros.core.errors import CalibrationFileError
from tests.helpers.calibrations import calibrated

MAGNIFICATIONS = (500.0, 1000.0, 2000.0, 4000.0)


@pytest.fixture(scope="module", params=["joint", "discrete", "pda"])
def calibration(request):
    options = CalibrationOptions(request.param)
    return Calibration.from_model(calibrated("jsm820", options, MAGNIFICATIONS, 3).model)


@pytest.mark.slow
def test_loading_gives_back_every_bit(calibration, tmp_path):
    path = tmp_path / "cal.yaml"
    calibration.save(path)
    loaded = Calibration.load(path)
    assert loaded.magnification_range == (500.0, 4000.0)
    assert loaded.method == calibration.method
    assert loaded.statistics["views"] == 12
    # One triangle is stored; the two differ by rounding at most.
    np.testing.assert_allclose(loaded.covariance, calibration.covariance, rtol=1e-9)
    for g in (500.0, 777.7, 4000.0, 9000.0):
        a, b = loaded.at(g), calibration.at(g)
        np.testing.assert_array_equal(a.parameters, b.parameters)
        assert a.in_range == b.in_range
    assert loaded.dumps() == calibration.dumps()


_ORIGIN = Provenance(
    "2026-01-02 03:04:05",
    ("2026-01-01 10:00:00", "2026-01-01 11:00:00"),
    "0.1.0",
    "grid",
    "0" * 64,
    "jsm820",
    "1" * 64,
    ("frame 0", "frame 2"),
    {"maker": ("tescan",), "working_distance_m": (0.009, 0.0091)},
)


def test_provenance_comes_back(calibration):
    known = replace(calibration, provenance=_ORIGIN)
    assert Calibration.loads(known.dumps()).provenance == _ORIGIN


def test_a_file_of_version_1_is_read_without_provenance(calibration):
    text = replace(calibration, provenance=Provenance()).dumps()
    assert "provenance" not in text
    old = text.replace("\nversion: 3\n", "\nversion: 1\n")
    assert old != text
    loaded = Calibration.loads(old)
    assert loaded.provenance == Provenance()
    np.testing.assert_array_equal(loaded.at(777.7).parameters, calibration.at(777.7).parameters)


@pytest.mark.parametrize(
    "wrong",
    [
        {"recording_sha256": "abc"},
        {"operator": "x"},
        {"conditions": {"working_distance_m": [0.01, float("inf")]}},
    ],
)
def test_wrong_provenance_is_refused(calibration, wrong):
    with pytest.raises(CalibrationFileError):
        Calibration.loads(_broken(calibration, lambda d: d.update(provenance=wrong)))


def _with_terms(names, residual=None):
    """Constants, and some functions that change with the magnification; everything correlates."""
    rng, limits = np.random.default_rng(0), (500.0, 4000.0)
    values = dict(
        zip(FUNCTION_NAMES, [1.02, 1.01, 0.002, 249, 262, 50, 0.02, 1e-3, 227, 267], strict=True)
    )
    functions = {
        name: ContinuousFunction("chebyshev_log", np.array([value, 1e-3 * value]), limits)
        for name, value in values.items()
    }
    functions |= {
        name: ContinuousFunction("chebyshev_log", rng.normal(0.0, 0.003, 1 + k % 2), limits)
        for k, name in enumerate(names)
    }
    size = sum(function.size for function in functions.values())
    size += 0 if residual is None else residual.size
    root = 1e-5 * rng.normal(size=(size, size + 5))
    return Calibration(
        functions=functions,
        covariance=root @ root.T,
        image_width=512,
        image_height=384,
        display_width_m=0.12,
        magnifications=(500.0, 1000.0, 4000.0),
        method="joint",
        residual=residual,
    )


def _assert_same(loaded, calibration):
    for g in (300.0, 500.0, 777.7, 4000.0, 9000.0):
        one, other = loaded.at(g), calibration.at(g)
        assert one.names == other.names
        np.testing.assert_array_equal(one.parameters, other.parameters)
        # One triangle is stored; the two differ by rounding at most.
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-9, atol=1e-25)
        xyz = one.sem_from_ideal([[3.0, 5.0], [200.0, 300.0], [500.0, 12.0]])
        np.testing.assert_array_equal(one.project(xyz), other.project(xyz))
    assert loaded.dumps() == calibration.dumps()


@pytest.mark.parametrize(
    "names",
    [TERM_NAMES, ("xi_s",), ("settling_2", "coil_y3"), ()],
    ids=["all", "spiral", "two of the scan", "none"],
)
@pytest.mark.parametrize("with_field", [False, True])
def test_terms_come_back_bit_for_bit_and_are_there_only_where_chosen(names, with_field, tmp_path):
    field = None
    if with_field:
        zero = zero_field((512, 384), (500.0, 4000.0), 1)
        values = np.random.default_rng(1).normal(0.0, 1e-3, zero.coefficients.shape)
        field = replace(zero, coefficients=values)
    calibration = _with_terms(names, field)
    written = yaml.safe_load(calibration.dumps())
    assert written["version"] == 3
    assert set(written["functions"]) == {*FUNCTION_NAMES, *names}
    calibration.save(tmp_path / "cal.yaml")
    loaded = Calibration.load(tmp_path / "cal.yaml")
    assert loaded.at(777.7).names == (ALL_NAMES if names else PARAMETER_NAMES)
    _assert_same(loaded, calibration)


def test_functions_may_stand_in_any_order():
    """The covariance is in the order of the model, whatever the order in the file."""
    calibration = _with_terms(TERM_NAMES)

    def turn(data):
        data["functions"] = dict(reversed(data["functions"].items()))

    text = _broken(calibration, turn)
    _assert_same(Calibration.loads(text), calibration)


@pytest.mark.parametrize("version", [1, 2])
def test_older_files_without_terms_give_the_same_cameras(version):
    calibration = _with_terms(())
    old = calibration.dumps().replace("\nversion: 3\n", f"\nversion: {version}\n")
    assert f"version: {version}" in old
    loaded = Calibration.loads(old)
    assert loaded.at(777.7).names == PARAMETER_NAMES
    _assert_same(loaded, calibration)


@pytest.mark.parametrize("name", ["coil_x1", "coil_z2", "settling_0", "xi_q", "settling_11"])
def test_terms_that_are_not_known_are_refused(name):
    calibration = _with_terms(("settling_1",))

    def rename(data):
        data["functions"][name] = data["functions"].pop("settling_1")

    with pytest.raises(CalibrationFileError, match=name):
        Calibration.loads(_broken(calibration, rename))


def _broken(calibration, edit):
    data = yaml.safe_load(calibration.dumps())
    edit(data)
    return yaml.safe_dump(data)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d.update(format="other"), "not a calibration file"),
        (lambda d: d.update(version=4), "update semcal_ros"),
        (lambda d: d.update(version=0), "calibrate again"),
        (lambda d: d.update(version="1"), "file version"),
        (lambda d: d.pop("functions"), "functions"),
        (lambda d: d["functions"].pop("rho"), "rho"),
        (lambda d: d["functions"]["rho"].update(kind="magic"), "functions.rho.kind"),
        (lambda d: d["functions"]["px"].update(coefficients=[float("nan")]), "finite"),
        (lambda d: d["functions"]["px"].update(coefficients=["a"]), "functions.px.coefficients"),
        (lambda d: d.update(display_width_m=-1.0), "display_width_m"),
        (lambda d: d.update(magnifications=[5.0, 1.0]), "ascending"),
        (lambda d: d["covariance"]["upper_rows"].pop(), "covariance"),
        (lambda d: d["covariance"]["upper_rows"][0].__setitem__(0, -1.0), "covariance"),
        (lambda d: d["covariance"]["upper_rows"][0].__setitem__(1, 1e6), "correlations"),
        (lambda d: d["covariance"]["upper_rows"][0].__setitem__(1, 1e308), "correlations"),
        (lambda d: d.update(surprise=1), "surprise"),
        (lambda d: d["magnifications"].append(1e6), "to 1e[+]06, and scale of"),
        (lambda d: d["magnifications"].insert(0, 1.0), "magnifications of 1 to"),
        (lambda d: d["scale_sigma"].update(repeatability=10**25), "a whole number of 26 digits"),
    ],
)
def test_wrong_files_are_refused_in_one_line(calibration, edit, message):
    with pytest.raises(CalibrationFileError, match=message) as caught:
        Calibration.loads(_broken(calibration, edit), source="cal.yaml")
    assert str(caught.value).startswith("cal.yaml: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text", ["", "{", "a: [1, 2", "- 1", "!!python/object:os.system x", "\x00", "7"]
)
def test_foreign_text_is_refused(text):
    with pytest.raises(CalibrationFileError):
        Calibration.loads(text)


def test_a_truncated_file_is_refused(calibration):
    text = calibration.dumps()
    for length in (10, len(text) // 3, len(text) // 2, len(text) - 20):
        with pytest.raises(CalibrationFileError):
            Calibration.loads(text[:length])


def test_missing_and_binary_files(tmp_path):
    with pytest.raises(CalibrationFileError, match="semcal calibrate"):
        Calibration.load(tmp_path / "none.yaml")
    with pytest.raises(CalibrationFileError):
        Calibration.load(tmp_path)
    binary = tmp_path / "x.yaml"
    binary.write_bytes(b"\xff\xfe\x00\x80" * 100)
    with pytest.raises(CalibrationFileError, match="not UTF-8 text"):
        Calibration.load(binary)


def test_a_failed_save_leaves_the_old_file(calibration, tmp_path, monkeypatch):
    path = tmp_path / "cal.yaml"
    calibration.save(path)
    before = path.read_bytes()

    def no_space(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", no_space)
    with pytest.raises(CalibrationFileError, match="No space left"):
        calibration.save(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["cal.yaml"]


def test_errors_are_in_one_tree():
    assert issubclass(CalibrationFileError, SemcalError)


def test_a_file_has_the_same_limit_as_the_topic(tmp_path):
    path = tmp_path / "cal.yaml"
    text = "#" * (MAX_TEXT_BYTES + 1)
    path.write_text(text)
    with pytest.raises(CalibrationFileError, match=f"at most {MAX_TEXT_BYTES}"):
        Calibration.load(path)
    with pytest.raises(CalibrationFileError, match=f"at most {MAX_TEXT_BYTES}"):
        Calibration.loads(text)
