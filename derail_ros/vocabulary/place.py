"""Where on the Earth a run is: the frame of the track, and latitude and longitude (WGS 84)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

EARTH_AXIS, EARTH_FLATTENING = 6_378_137.0, 1.0 / 298.257223563
"""Ellipsoid of WGS 84: half axis, m, and flattening."""


@dataclass(frozen=True)
class Datum:
    """Where on the Earth the origin of the inertial frame is (WGS 84).

    ``azimuth`` is the direction of its x axis, rad, clockwise from north.
    """

    latitude: float  # deg, north positive
    longitude: float  # deg, east positive
    altitude: float = 0.0  # m above the ellipsoid
    azimuth: float = 0.5 * math.pi

    def _degree(self) -> tuple[float, float]:
        """Metres that a radian of latitude and one of longitude span at the datum."""
        latitude = math.radians(self.latitude)
        e2 = EARTH_FLATTENING * (2.0 - EARTH_FLATTENING)
        w = math.sqrt(1.0 - e2 * math.sin(latitude) ** 2)
        across = EARTH_AXIS / w + self.altitude
        along = EARTH_AXIS * (1.0 - e2) / w**3 + self.altitude
        return along, across * math.cos(latitude)

    def fix(self, x: float, y: float, z: float = 0.0) -> tuple[float, float, float]:
        """Latitude, longitude (deg) and altitude (m) of a place of the inertial frame, m.

        By the radii of curvature at the datum, as on a plane that touches the ellipsoid there:
        1 km away it is right to a decimetre, and the error grows with the square.
        """
        c, s = math.cos(self.azimuth), math.sin(self.azimuth)
        north, east = c * x + s * y, s * x - c * y
        along, across = self._degree()
        return (
            self.latitude + math.degrees(north / along),
            self.longitude + math.degrees(east / across),
            self.altitude + z,
        )

    def local(self, latitude: float, longitude: float) -> tuple[float, float]:
        """Place x, y of the inertial frame, m, of a latitude and longitude (deg): undoes `fix`."""
        c, s = math.cos(self.azimuth), math.sin(self.azimuth)
        along, across = self._degree()
        north = math.radians(latitude - self.latitude) * along
        turn = (longitude - self.longitude + 180.0) % 360.0 - 180.0
        east = math.radians(turn) * across
        return c * north + s * east, s * north - c * east


def datum_of(site: Mapping[str, Any] | None) -> Datum | None:
    """The datum of the section ``site`` of a resolved scenario, if it has one."""
    data = (site or {}).get("datum")
    if data is None:
        return None
    azimuth = math.radians(data["azimuth_deg"])
    return Datum(data["latitude_deg"], data["longitude_deg"], data["altitude_m"], azimuth)
