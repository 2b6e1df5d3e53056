// Positions on Earth, in WGS 84, of points of the cell's frame.

/// Semi-major axis in metres and squared eccentricity of the ellipsoid.
const SEMI_MAJOR_M = 6378137;
const SQUARED_ECCENTRICITY = 0.00669437999014;
/// Steps after which the latitude is exact near the ground.
const LATITUDE_STEPS = 5;

const radians = (degrees) => (degrees * Math.PI) / 180;

/// Angle in degrees, clockwise, from the frame's y axis to north. Without an origin the y axis is north.
export const northOf = (origin) => origin?.rotation_deg ?? 0;

/// Latitude and longitude in degrees of a point { x_m, y_m } in the tangent plane at the origin.
export function onEarth({ x_m, y_m }, { latitude_deg, longitude_deg, height_m, rotation_deg }) {
  const turn = radians(rotation_deg);
  const [east, north] = [x_m * Math.cos(turn) - y_m * Math.sin(turn), x_m * Math.sin(turn) + y_m * Math.cos(turn)];
  const [sin, cos] = [Math.sin(radians(latitude_deg)), Math.cos(radians(latitude_deg))];
  const curvature = (sine) => SEMI_MAJOR_M / Math.sqrt(1 - SQUARED_ECCENTRICITY * sine * sine);
  const radius = curvature(sin);
  // Earth-centred, in metres: from the axis towards the origin's meridian, and along the axis.
  const outward = (radius + height_m) * cos - north * sin;
  const along = (radius * (1 - SQUARED_ECCENTRICITY) + height_m) * sin + north * cos;
  const distance = Math.hypot(outward, east);
  let latitude = Math.atan2(along, distance * (1 - SQUARED_ECCENTRICITY));
  for (let step = 0; step < LATITUDE_STEPS; step += 1) {
    const sine = Math.sin(latitude);
    latitude = Math.atan2(along + SQUARED_ECCENTRICITY * curvature(sine) * sine, distance);
  }
  const longitude = longitude_deg + (Math.atan2(east, outward) * 180) / Math.PI;
  return [(latitude * 180) / Math.PI, ((longitude + 540) % 360) - 180];
}

/// Latitude and longitude in words.
export function inDegrees(point, origin, decimals) {
  const [latitude, longitude] = onEarth(point, origin);
  const half = (degrees, positive, negative) => `${Math.abs(degrees).toFixed(decimals)}° ${degrees < 0 ? negative : positive}`;
  return `${half(latitude, "N", "S")}, ${half(longitude, "E", "W")}`;
}
