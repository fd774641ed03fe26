// Voxels where they lie: brick number → slot → words. `word(chunk, n)` is generated for as many buffers as there are.

@group(0) @binding(3) var<storage, read> slots: array<u32>;

struct Place {
    // which buffer, and the voxel of the cell's lower corner in it
    chunk: u32,
    corner: u32,
    fraction: vec3<f32>,
}

fn low_half(word: u32) -> f32 {
    return f32(bitcast<i32>(word << 16u) >> 16u);
}

fn high_half(word: u32) -> f32 {
    return f32(bitcast<i32>(word) >> 16u);
}

// Lower corner of the trilinear cell around p.
fn cell_of(p: vec3<f32>) -> vec3<i32> {
    let last = vec3<i32>(LAST_CELL_X, LAST_CELL_Y, LAST_CELL_Z);
    return min(vec3<i32>(clamp(p, vec3<f32>(0.0), vec3<f32>(1e6))), last);
}

fn locate(p: vec3<f32>) -> Place {
    let base = cell_of(p);
    let brick = base / EDGE;
    let local = vec3<u32>(base - brick * EDGE);
    let slot = slots[u32((brick.z * BRICKS_Y + brick.y) * BRICKS_X + brick.x)];
    let corner = (slot & SLOT_MASK) * HALVES + (local.z + 1u) * SLICE + (local.y + 1u) * ROW + local.x + 1u;
    return Place(slot >> SLOT_BITS, corner, clamp(p - vec3<f32>(base), vec3<f32>(0.0), vec3<f32>(1.0)));
}

// Two neighbours along x.
fn pair(chunk: u32, n: u32) -> vec2<f32> {
    let a = word(chunk, n >> 1u);
    if ((n & 1u) == 0u) {
        return vec2<f32>(low_half(a), high_half(a));
    }
    return vec2<f32>(high_half(a), low_half(word(chunk, (n >> 1u) + 1u)));
}

fn lerp(a: f32, b: f32, t: f32) -> f32 {
    return a + (b - a) * t;
}

// Trilinear stored value.
fn value(place: Place) -> f32 {
    let o = place.corner;
    let f = place.fraction;
    let a = pair(place.chunk, o);
    let b = pair(place.chunk, o + ROW);
    let c = pair(place.chunk, o + SLICE);
    let d = pair(place.chunk, o + SLICE + ROW);
    let near = lerp(lerp(a.x, a.y, f.x), lerp(b.x, b.y, f.x), f.y);
    let far = lerp(lerp(c.x, c.y, f.x), lerp(d.x, d.y, f.x), f.y);
    return lerp(near, far, f.z);
}
