"""Positions of a cell's map on Earth (WGS 84), by the tangent plane at the map's origin."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import lru_cache
from math import atan2, cos, degrees, hypot, radians, sin, sqrt
from typing import Optional

from .codec import number_of
from .errors import Invalid
from .messages import Pose, check_azimuth

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

# The ellipsoid of WGS 84: semi-major axis in metres and squared eccentricity.
A = 6_378_137.0
E2 = (2 - 1 / 298.257223563) / 298.257223563

# Maximum distance of a pose from the origin in metres: maps are flat, and Earth is not.
MAX_DISTANCE_M = 100_000.0


@dataclass(frozen=True)
class Origin:
    """The place of a map's origin: degrees, and metres above the ellipsoid.

    `rotation_rad` is the direction of the map's x axis, counter-clockwise from true east. `Cell.origin` gives that of a
    cell.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float = 0.0
    rotation_rad: float = 0.0

    def __post_init__(self) -> None:
        try:
            _check_place(self.latitude_deg, self.longitude_deg, self.height_m)
            number_of(self.rotation_rad, "rotation_rad")
        except Invalid as error:
            raise Invalid(f"{self}: {error}") from None

    @staticmethod
    @lru_cache(maxsize=4)
    def of(description: str) -> Optional[Origin]:
        """The origin in the text of a cell's description, if there is one."""
        try:
            table = tomllib.loads(description).get("origin")
            if table is None:
                return None
            rotation = radians(table.get("rotation_deg", 0.0))
            return Origin(float(table["latitude_deg"]), float(table["longitude_deg"]), float(table.get("height_m", 0.0)), rotation)
        except (tomllib.TOMLDecodeError, LookupError, TypeError, ValueError, AttributeError) as error:
            raise Invalid(f"the description of the cell has no usable [origin]: {error!r}") from error

    def to_wgs84(self, x_m: float, y_m: float, z_m: float = 0.0) -> tuple[float, float, float]:
        """Latitude and longitude in degrees, and height above the ellipsoid, of a position in the map.

        `z_m` is the height above the tangent plane. Without it latitude and longitude of what stands on the ground are
        right to 2 mm within 5 km, and the height is up to 2 m too large. Raises `Invalid` for what is no finite number.
        """
        x_m, y_m, z_m = (number_of(value, name) for value, name in ((x_m, "x_m"), (y_m, "y_m"), (z_m, "z_m")))
        x, y, z = (a + b for a, b in zip(_ecef(self.latitude_deg, self.longitude_deg, self.height_m), self._to_earth(x_m, y_m, z_m)))
        return _geodetic(x, y, z)

    def to_map(self, latitude_deg: float, longitude_deg: float, height_m: Optional[float] = None) -> tuple[float, float, float]:
        """The position in the map of a place on Earth: x, y, and height above the tangent plane, in metres.

        Without a height, that of the origin counts. Raises `Invalid` for a latitude beyond ±90°, as of swapped arguments, a
        longitude beyond ±360°, and what is no finite number.
        """
        _check_place(latitude_deg, longitude_deg, height_m)
        there = _ecef(latitude_deg, longitude_deg, self.height_m if height_m is None else height_m)
        x, y, z = (a - b for a, b in zip(there, _ecef(self.latitude_deg, self.longitude_deg, self.height_m)))
        return self._from_earth(x, y, z)

    def pose(self, latitude_deg: float, longitude_deg: float, azimuth_deg: float, height_m: Optional[float] = None) -> Pose:
        """The pose in the map of one on Earth, for `Cell.report`. `azimuth_deg` is the heading, clockwise from true north.

        Without a height, that of the origin counts: 10 m of error move a pose that is 5 km away by 8 mm. Raises `Invalid`
        for a place that is more than 100 km away, and for an azimuth beyond ±360°.
        """
        azimuth_deg = number_of(azimuth_deg, "azimuth_deg")
        check_azimuth(azimuth_deg)
        height_m = self.height_m if height_m is None else height_m
        there = Origin(latitude_deg, longitude_deg, height_m)
        x, y, z = self.to_map(latitude_deg, longitude_deg, height_m)
        if not x * x + y * y + z * z <= MAX_DISTANCE_M**2:
            raise Invalid(f"{there} is more than {MAX_DISTANCE_M / 1000:.0f} km from {self}; check both")
        # North there is not quite the direction of north here.
        ahead_x, ahead_y, _ = self._from_earth(*there._to_earth(sin(radians(azimuth_deg)), cos(radians(azimuth_deg)), 0.0))
        return Pose(x, y, atan2(ahead_y, ahead_x))

    def _to_earth(self, x: float, y: float, z: float) -> tuple[float, float, float]:
        """A direction in the map as one in the axes of Earth."""
        c, s = cos(self.rotation_rad), sin(self.rotation_rad)
        east, north = x * c - y * s, x * s + y * c
        sin_lat, cos_lat, sin_lon, cos_lon = self._angles()
        return (
            -sin_lon * east - sin_lat * cos_lon * north + cos_lat * cos_lon * z,
            cos_lon * east - sin_lat * sin_lon * north + cos_lat * sin_lon * z,
            cos_lat * north + sin_lat * z,
        )

    def _from_earth(self, x: float, y: float, z: float) -> tuple[float, float, float]:
        """A direction in the axes of Earth as one in the map."""
        sin_lat, cos_lat, sin_lon, cos_lon = self._angles()
        east = -sin_lon * x + cos_lon * y
        north = -sin_lat * cos_lon * x - sin_lat * sin_lon * y + cos_lat * z
        up = cos_lat * cos_lon * x + cos_lat * sin_lon * y + sin_lat * z
        c, s = cos(self.rotation_rad), sin(self.rotation_rad)
        return east * c + north * s, north * c - east * s, up

    def _angles(self) -> tuple[float, float, float, float]:
        lat, lon = radians(self.latitude_deg), radians(self.longitude_deg)
        return sin(lat), cos(lat), sin(lon), cos(lon)


def _check_place(latitude_deg: float, longitude_deg: float, height_m: Optional[float]) -> None:
    for value, name, most in (
        (latitude_deg, "latitude_deg", 90.0),
        (longitude_deg, "longitude_deg", 360.0),
        (0.0 if height_m is None else height_m, "height_m", 1e8),
    ):
        if abs(number_of(value, name)) > most:
            raise Invalid(f"{name}: {value} must be from {-most:g} to {most:g}")


def _ecef(latitude_deg: float, longitude_deg: float, height_m: float) -> tuple[float, float, float]:
    lat, lon = radians(latitude_deg), radians(longitude_deg)
    n = A / sqrt(1 - E2 * sin(lat) ** 2)
    return (n + height_m) * cos(lat) * cos(lon), (n + height_m) * cos(lat) * sin(lon), (n * (1 - E2) + height_m) * sin(lat)


def _geodetic(x: float, y: float, z: float) -> tuple[float, float, float]:
    """By iteration on the latitude, which converges to less than a micrometre near the ground."""
    p = hypot(x, y)
    lat = atan2(z, p * (1 - E2))
    for _ in range(6):
        n = A / sqrt(1 - E2 * sin(lat) ** 2)
        lat = atan2(z + E2 * n * sin(lat), p)
    n = A / sqrt(1 - E2 * sin(lat) ** 2)
    height = p * cos(lat) + z * sin(lat) - A * A / n
    return degrees(lat), degrees(atan2(y, x)), height
