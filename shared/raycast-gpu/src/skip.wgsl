// The map of empty space: a byte a cell, four to a word.

@group(0) @binding(4) var<storage, read> distances: array<u32>;

fn state_of(cell: vec3<i32>) -> u32 {
    let n = u32((cell.z * CELLS_Y + cell.y) * CELLS_X + cell.x);
    return (distances[n >> 2u] >> ((n & 3u) * 8u)) & 0xffu;
}

// Steps from p, in an empty cell, to where the box of empty cells d − 1 cells beyond it on every side ends.
fn box_exit(delta: vec3<f32>, d: f32, cell: vec3<i32>, p: vec3<f32>) -> f32 {
    let side = select(vec3<f32>(1.0 - d), vec3<f32>(d), delta > vec3<f32>(0.0));
    let t = (f32(CELL) * (vec3<f32>(cell) + side) - p) / delta;
    return min(t.x, min(t.y, t.z));
}
