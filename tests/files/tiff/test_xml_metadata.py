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

"""XML in tag 34683: Phenom, and the newer programs of Thermo Fisher."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import tifffile

from semcal_ros.core.errors import TiffError
from semcal_ros.files.tiff.read import read_sem_tiff

PIXELS = (np.arange(20 * 32) % 251).astype(np.uint8).reshape(20, 32)

PHENOM = """<?xml version="1.0" encoding="UTF-8"?>
<FeiImage xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance">
  <databarHeight>4</databarHeight>
  <displayWidth unit="m">0.4</displayWidth>
  <pixelWidth unit="nm">975.779</pixelWidth>
  <pixelHeight unit="nm">975.779</pixelHeight>
  <time>2019-08-07T09:37:31</time>
  <integrations>16</integrations>
  <acquisition><scan>
    <dwellTime unit="ns">200</dwellTime>
    <rotation>0</rotation>
    <detector>bsd-all</detector>
    <highVoltage unit="kV">-15</highVoltage>
  </scan></acquisition>
  <workingDistance unit="mm">8.14</workingDistance>
  <instrument><type>PhenomXL</type><uniqueID>MVE027364-0026-L</uniqueID></instrument>
</FeiImage>"""

THERMO_FISHER = """<?xml version="1.0"?>
<Metadata xmlns:nil="http://schemas.fei.com/Metadata/v1/2013/07">
  <Instrument><InstrumentClass>Helios 5</InstrumentClass><InstrumentID>9954108</InstrumentID></Instrument>
  <Acquisition>
    <AcquisitionDatetime>2022-10-04T08:41:33.1234567+02:00</AcquisitionDatetime><BeamType>Ion</BeamType>
  </Acquisition>
  <Optics>
    <AccelerationVoltage>2000</AccelerationVoltage><WorkingDistance>0.0038</WorkingDistance>
    <SampleTiltCorrectionOn>false</SampleTiltCorrectionOn>
  </Optics>
  <StageSettings><StagePosition>
    <Rotation>-3.1</Rotation><Tilt><Alpha>0.47</Alpha><Beta>0</Beta></Tilt>
  </StagePosition></StageSettings>
  <ScanSettings>
    <DwellTime>3E-07</DwellTime><FrameTime>1.2156768</FrameTime><ScanRotation>3.14</ScanRotation>
  </ScanSettings>
  <Detectors><ScanningDetector><DetectorName>ETD</DetectorName></ScanningDetector></Detectors>
  <BinaryResult>
    <ImageSize><X>32</X><Y>17</Y></ImageSize>
    <PixelSize>
      <X unit="m" unitPrefixPower="1">2.69E-07</X><Y unit="m" unitPrefixPower="1">2.69E-07</Y>
    </PixelSize>
  </BinaryResult>
</Metadata>"""


def write(path: Path, text: str) -> Path:
    data = text.encode() + b"\x00"
    tifffile.imwrite(path, PIXELS, extratags=[(34683, 2, len(data), data, True)])
    return path


def test_phenom(tmp_path: Path) -> None:
    sem = read_sem_tiff(write(tmp_path / "p.tif", PHENOM))
    own = sem.settings
    assert sem.maker == "phenom"
    assert sem.pixel_size_m == pytest.approx(975.779e-9, rel=1e-12, abs=0)
    assert np.array_equal(sem.image, PIXELS[:16])
    assert sem.display_width_m == pytest.approx(0.4)
    assert own.acceleration_voltage_v == pytest.approx(15e3)
    assert own.working_distance_m == pytest.approx(8.14e-3)
    assert own.dwell_s == pytest.approx(200e-9)
    assert own.scan_rotation_rad == 0.0
    assert (own.model, own.serial_number) == ("PhenomXL", "MVE027364-0026-L")
    assert own.detector == "bsd-all"
    assert own.time == datetime(2019, 8, 7, 9, 37, 31)


def test_phenom_rotation_without_a_unit_is_left_out(tmp_path: Path) -> None:
    text = PHENOM.replace("<rotation>0<", "<rotation>30<")
    sem = read_sem_tiff(write(tmp_path / "p.tif", text))
    assert sem.scan_rotation_rad is None
    assert any("scan rotation is 30 without a unit" in note for note in sem.notes)


def test_thermo_fisher_xml(tmp_path: Path) -> None:
    sem = read_sem_tiff(write(tmp_path / "t.tif", THERMO_FISHER))
    own = sem.settings
    assert sem.maker == "thermo_fisher"
    assert sem.pixel_size_m == 2.69e-7
    assert (sem.databar_rows, sem.image.shape) == (3, (17, 32))
    assert (own.beam, own.acceleration_voltage_v, own.working_distance_m) == ("ion", 2e3, 0.0038)
    assert (own.stage_tilt_rad, own.stage_rotation_rad, own.scan_rotation_rad) == (0.47, -3.1, 3.14)
    assert (own.dwell_s, own.frame_time_s) == (3e-7, 1.2156768)
    assert (own.model, own.serial_number, own.detector) == ("Helios 5", "9954108", "ETD")
    assert own.time == datetime(2022, 10, 4, 8, 41, 33)
    assert own.notes == ()


def test_text_in_sections_counts_before_xml(tmp_path: Path) -> None:
    data, xml = b"[Scan]\nPixelWidth=1e-9\nPixelHeight=1e-9\n\x00", THERMO_FISHER.encode() + b"\x00"
    path = tmp_path / "b.tif"
    tags = [(34682, 2, len(data), data, True), (34683, 2, len(xml), xml, True)]
    tifffile.imwrite(path, PIXELS, extratags=tags)
    assert read_sem_tiff(path).pixel_size_m == 1e-9
    # What newer programs put into 34680 has no sections.
    data = b"PE1lbWVudG9JdGVt\x00"
    tags = [(34680, 2, len(data), data, True), (34683, 2, len(xml), xml, True)]
    tifffile.imwrite(path, PIXELS, extratags=tags)
    assert read_sem_tiff(path).pixel_size_m == 2.69e-7


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (PHENOM.replace('pixelWidth unit="nm"', 'pixelWidth unit="V"'), "pixelWidth"),
        (PHENOM.replace('pixelWidth unit="nm"', "pixelWidth"), "pixelWidth"),
        (PHENOM.replace(">4<", ">20<"), "databarHeight"),
        (THERMO_FISHER.replace('<X unit="m"', '<X unit="1/m"'), "PixelSize"),
        (THERMO_FISHER.replace("<X>32<", "<X>64<"), "original file"),
        (PHENOM[:-5], "not XML"),
        ("<Root></Root>", "root 'Root'"),
        ("", "not XML"),
        (
            '<!DOCTYPE a [<!ENTITY b "1"><!ENTITY c "&b;&b;">]><FeiImage>&c;</FeiImage>',
            "declarations",
        ),
    ],
)
def test_unusable_xml_is_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(TiffError, match=message) as caught:
        read_sem_tiff(write(tmp_path / "x.tif", text))
    assert "x.tif" in str(caught.value)
    assert "\n" not in str(caught.value)
