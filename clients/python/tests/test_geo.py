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


def test_a_place_without_a_height_is_as_high_as_the_origin() -> None:
    origin = ecod.geo.Origin(39.74, -104.99, 1600.0)
    latitude, longitude, _ = origin.to_wgs84(3000.0, -4000.0)
    assert origin.to_map(latitude, longitude) == origin.to_map(latitude, longitude, 1600.0)
    assert origin.to_map(latitude, longitude)[:2] == pytest.approx((3000.0, -4000.0), abs=0.002)


def test_a_map_that_is_turned_has_its_x_axis_in_that_direction() -> None:
    plain = ecod.geo.Origin(52.0, 21.0)
    turned = ecod.geo.Origin(52.0, 21.0, rotation_rad=math.radians(30))
    east, north = 100 * math.cos(math.radians(30)), 100 * math.sin(math.radians(30))
    assert turned.to_wgs84(100, 0) == pytest.approx(plain.to_wgs84(east, north), abs=1e-12)
    assert turned.to_map(*turned.to_wgs84(3, 4, 5)) == pytest.approx((3, 4, 5), abs=1e-6)


@pytest.mark.parametrize("place", ORIGINS)
def test_a_heading_is_clockwise_from_the_north_of_where_the_vehicle_is(place: tuple[float, float, float]) -> None:
    origin = ecod.geo.Origin(*place, rotation_rad=math.radians(30))
    geod = pyproj.Geod(ellps="WGS84")
    draw = random.Random(2)
    for _ in range(50):
        lat, lon, _ = origin.to_wgs84(draw.uniform(-5000, 5000), draw.uniform(-5000, 5000))
        azimuth, height = draw.uniform(-180, 180), place[2]
        pose = origin.pose(lat, lon, azimuth)
        assert (pose.x_m, pose.y_m) == pytest.approx(origin.to_map(lat, lon, height)[:2], abs=1e-6)
        ahead_lon, ahead_lat, _ = geod.fwd(lon, lat, azimuth, 20.0)
        ahead_x, ahead_y, _ = origin.to_map(ahead_lat, ahead_lon, height)
        there = math.atan2(ahead_y - pose.y_m, ahead_x - pose.x_m)
        assert math.remainder(pose.heading_rad - there, math.tau) == pytest.approx(0.0, abs=1e-5)
    north = ecod.geo.Origin(*place).pose(*place[:2], 0.0, height_m=place[2])
    assert (north.x_m, north.y_m, north.heading_rad) == pytest.approx((0.0, 0.0, math.pi / 2), abs=1e-6)
    for far in ((place[0], place[1] / 2 + 60), (-place[0], place[1] + 180)):
        with pytest.raises(ecod.Invalid, match="more than 100 km"):
            ecod.geo.Origin(*place).pose(*far, 0.0)


def test_the_origin_is_read_from_the_description_of_a_cell() -> None:
    described = '[origin]\nlatitude_deg = 52\nlongitude_deg = 21.5\nrotation_deg = 90\n[fusion.pace]\ngate_m = 1\n'
    assert ecod.geo.Origin.of(described) == ecod.geo.Origin(52.0, 21.5, 0.0, math.pi / 2)
    assert ecod.geo.Origin.of("") is None and ecod.geo.Origin.of("[fusion.pace]\ngate_m = 1") is None
    for unusable in ("[origin", "[origin]\nlatitude_deg = 52", "origin = 7", '[origin]\nlatitude_deg = "north"\nlongitude_deg = 1'):
        with pytest.raises(ecod.Invalid, match=r"no usable \[origin\]"):
            ecod.geo.Origin.of(unusable)


@pytest.mark.parametrize("wrong", [(91.0, 0.0), (math.nan, 0.0), (0.0, 361.0), (0.0, 0.0, math.inf)])
def test_an_origin_that_is_nowhere_is_refused(wrong: tuple[float, ...]) -> None:
    with pytest.raises(ecod.Invalid, match="latitude"):
        ecod.geo.Origin(*wrong)
