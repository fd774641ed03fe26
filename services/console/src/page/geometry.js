// Patient millimetres (LPS: x to the left, y to the back, z to the head) ↔ pixels of a view.

export const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
export const sub = (a, b) => add(a, b, -1);
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const norm = (a) => Math.hypot(...a);
export const unit = (a) => { const n = norm(a) || 1; return a.map((v) => v / n); };
export const clamp = (v, low, high) => Math.min(high, Math.max(low, v));

// Rotates v about the unit axis k by an angle [rad] (Rodrigues).
export function rotate(v, k, angle) {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return add(add(v.map((x) => x * c), cross(k, v), s), k, dot(k, v) * (1 - c));
}

// The letter of the patient's side that a direction points to most.
export function letter(direction) {
  const a = direction.map(Math.abs);
  const c = a.indexOf(Math.max(...a));
  return [["R", "L"], ["A", "P"], ["I", "S"]][c][direction[c] > 0 ? 1 : 0];
}

// Directions of a section's right and bottom, and the axis it is perpendicular to.
export const PLANES = {
  axial: { right: [1, 0, 0], down: [0, 1, 0], normal: 2 },
  coronal: { right: [1, 0, 0], down: [0, 0, -1], normal: 1 },
  sagittal: { right: [0, 1, 0], down: [0, 0, -1], normal: 0 },
};

// A section as the renderer draws it: the whole box of voxel centres, centred, equally many millimetres across and down.
export class SectionMap {
  constructor(plane, low, high, width, height) {
    Object.assign(this, PLANES[plane], { width, height });
    const extent = low.map((l, c) => high[c] - l);
    const along = (d) => Math.abs(dot(extent, d));
    this.mm = Math.max(along(this.right) / Math.max(width - 1, 1), along(this.down) / Math.max(height - 1, 1), 1e-6);
    this.center = low.map((l, c) => (l + high[c]) / 2);
  }
  // Pixel [x, y] of a position; its distance from the plane does not matter.
  pixel(p) {
    const d = sub(p, this.center);
    return [dot(d, this.right) / this.mm + (this.width - 1) / 2, dot(d, this.down) / this.mm + (this.height - 1) / 2];
  }
  // Position of a pixel in the plane at `at` mm along its normal.
  position(x, y, at) {
    const p = add(add(this.center, this.right, (x - (this.width - 1) / 2) * this.mm), this.down, (y - (this.height - 1) / 2) * this.mm);
    p[this.normal] = at;
    return p;
  }
  // Millimetres of a step in pixels.
  step(dx, dy) { return add(this.right.map((v) => v * dx * this.mm), this.down, dy * this.mm); }
  // Into the picture.
  get forward() { return cross(this.right, this.down); }
}

// A perspective camera with a vertical field of view.
export class CameraMap {
  constructor({ eye, target, up, fov }, width, height) {
    this.eye = eye;
    this.forward = unit(sub(target, eye));
    this.right = unit(cross(this.forward, up));
    this.up = cross(this.right, this.forward);
    this.focal = height / 2 / Math.tan((fov * Math.PI) / 360); // pixels
    this.width = width; this.height = height;
  }
  // [x, y, depth in mm], or null behind the eye.
  pixel(p) {
    const d = sub(p, this.eye), depth = dot(d, this.forward);
    if (depth < 1e-3) return null;
    const s = this.focal / depth;
    return [dot(d, this.right) * s + (this.width - 1) / 2, -dot(d, this.up) * s + (this.height - 1) / 2, depth];
  }
  // Millimetres of a step in pixels parallel to the screen at a depth.
  step(dx, dy, depth) { return add(this.right.map((v) => (v * dx * depth) / this.focal), this.up, (-dy * depth) / this.focal); }
}
