// Vectors as arrays of three numbers, unit quaternions as (w, x, y, z).
function plus(a, b, factor = 1) {
  return [a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]];
}

function length(a) {
  return Math.hypot(a[0], a[1], a[2]);
}

function scaled(a, factor) {
  return [factor * a[0], factor * a[1], factor * a[2]];
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

function unit(a) {
  const size = length(a);
  return size > 0 ? scaled(a, 1 / size) : [0, 0, 0];
}

// Columns of the rotation matrix of a quaternion, which need not be of length one.
function axesOf(q) {
  const n = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
  const s = n > 0 ? 2 / n : 0;
  const [w, x, y, z] = q;
  return [
    [1 - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y)],
    [s * (x * y - w * z), 1 - s * (x * x + z * z), s * (y * z + w * x)],
    [s * (x * z + w * y), s * (y * z - w * x), 1 - s * (x * x + y * y)],
  ];
}

// A vector with components along given axes.
function combine(axes, v) {
  return plus(plus(scaled(axes[0], v[0]), axes[1], v[1]), axes[2], v[2]);
}

// A vector turned by a rotation vector [rad] (Rodrigues' formula).
function turnedBy(rotation, v) {
  const angle = length(rotation);
  if (!(angle > 1e-12)) return v;
  const n = scaled(rotation, 1 / angle);
  const along = n[0] * v[0] + n[1] * v[1] + n[2] * v[2];
  const c = Math.cos(angle);
  return plus(plus(scaled(v, c), cross(n, v), Math.sin(angle)), n, along * (1 - c));
}

// Two unit vectors that are perpendicular to one.
function across(direction) {
  const helper = Math.abs(direction[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0];
  const first = unit(cross(direction, helper));
  return [first, cross(direction, first)];
}
