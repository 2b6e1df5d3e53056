"""Positions on Earth against PROJ."""

from __future__ import annotations

import math
import random

import pyproj
import pytest

import ecod

ORIGINS = [(52.2296756, 21.0122287, 113.0), (-33.8688, 151.2093, 58.0), (0.0, 0.0, 0.0), (78.2, 15.6, -30.0), (37.4, -179.99, 2500.0)]


@pytest.mark.parametrize("place", ORIGINS)
def test_positions_within_five_kilometres_are_those_of_proj_to_a_millimetre(place: tuple[float, float, float]) -> None:
    latitude, longitude, height = place
    proj = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 "
        f"+lat_0={latitude} +lon_0={longitude} +h_0={height} +step +inv +proj=cart +ellps=WGS84"
    )
    geod = pyproj.Geod(ellps="WGS84")
    draw = random.Random(1)
    origin = ecod.geo.Origin(*place)
    for _ in range(200):
        x, y, z = draw.uniform(-5000, 5000), draw.uniform(-5000, 5000), draw.uniform(-50, 50)
        lat, lon, h = origin.to_wgs84(x, y, z)
        their_lon, their_lat, their_h = proj.transform(x, y, z, radians=False, errcheck=True)
        _, _, apart = geod.inv(lon, lat, their_lon, their_lat)
        assert apart < 0.001 and abs(h - their_h) < 0.001
        assert origin.to_map(their_lat, their_lon, their_h) == pytest.approx((x, y, z), abs=0.001)


def test_a_map_that_is_turned_has_its_x_axis_in_that_direction() -> None:
    plain = ecod.geo.Origin(52.0, 21.0)
    turned = ecod.geo.Origin(52.0, 21.0, rotation_rad=math.radians(30))
    east, north = 100 * math.cos(math.radians(30)), 100 * math.sin(math.radians(30))
    assert turned.to_wgs84(100, 0) == pytest.approx(plain.to_wgs84(east, north), abs=1e-12)
    assert turned.to_map(*turned.to_wgs84(3, 4, 5)) == pytest.approx((3, 4, 5), abs=1e-6)


@pytest.mark.parametrize("wrong", [(91.0, 0.0), (math.nan, 0.0), (0.0, 361.0), (0.0, 0.0, math.inf)])
def test_an_origin_that_is_nowhere_is_refused(wrong: tuple[float, ...]) -> None:
    with pytest.raises(ecod.Invalid, match="latitude"):
        ecod.geo.Origin(*wrong)
