"""Positions of a cell's map on Earth (WGS 84), by the tangent plane at the map's origin."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, degrees, hypot, isfinite, radians, sin, sqrt

from .errors import Invalid

# The ellipsoid of WGS 84: semi-major axis in metres and squared eccentricity.
A = 6_378_137.0
E2 = (2 - 1 / 298.257223563) / 298.257223563


@dataclass(frozen=True)
class Origin:
    """The place of a map's origin: degrees, and metres above the ellipsoid.

    `rotation_rad` is the direction of the map's x axis, counter-clockwise from true east.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float = 0.0
    rotation_rad: float = 0.0

    def __post_init__(self) -> None:
        values = (self.latitude_deg, self.longitude_deg, self.height_m, self.rotation_rad)
        if not all(map(isfinite, values)) or abs(self.latitude_deg) > 90 or abs(self.longitude_deg) > 360:
            raise Invalid(f"{self} must have a latitude of ±90°, a longitude of ±360°, and finite numbers")

    def to_wgs84(self, x_m: float, y_m: float, z_m: float = 0.0) -> tuple[float, float, float]:
        """Latitude and longitude in degrees, and height above the ellipsoid, of a position in the map."""
        east = x_m * cos(self.rotation_rad) - y_m * sin(self.rotation_rad)
        north = x_m * sin(self.rotation_rad) + y_m * cos(self.rotation_rad)
        x, y, z = _ecef(self.latitude_deg, self.longitude_deg, self.height_m)
        sin_lat, cos_lat, sin_lon, cos_lon = self._axes()
        return _geodetic(
            x - sin_lon * east - sin_lat * cos_lon * north + cos_lat * cos_lon * z_m,
            y + cos_lon * east - sin_lat * sin_lon * north + cos_lat * sin_lon * z_m,
            z + cos_lat * north + sin_lat * z_m,
        )

    def to_map(self, latitude_deg: float, longitude_deg: float, height_m: float = 0.0) -> tuple[float, float, float]:
        """The position in the map of a place on Earth: x, y, and height above the tangent plane, in metres."""
        here = _ecef(latitude_deg, longitude_deg, height_m)
        x, y, z = (a - b for a, b in zip(here, _ecef(self.latitude_deg, self.longitude_deg, self.height_m)))
        sin_lat, cos_lat, sin_lon, cos_lon = self._axes()
        east = -sin_lon * x + cos_lon * y
        north = -sin_lat * cos_lon * x - sin_lat * sin_lon * y + cos_lat * z
        up = cos_lat * cos_lon * x + cos_lat * sin_lon * y + sin_lat * z
        c, s = cos(self.rotation_rad), sin(self.rotation_rad)
        return east * c + north * s, north * c - east * s, up

    def _axes(self) -> tuple[float, float, float, float]:
        lat, lon = radians(self.latitude_deg), radians(self.longitude_deg)
        return sin(lat), cos(lat), sin(lon), cos(lon)


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
