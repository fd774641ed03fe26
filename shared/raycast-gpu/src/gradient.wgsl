// Gradients.

fn plane(a: vec2<f32>, b: vec2<f32>, c: vec2<f32>, d: vec2<f32>, f: vec3<f32>) -> f32 {
    let near = lerp(lerp(a.x, a.y, f.x), lerp(b.x, b.y, f.x), f.y);
    let far = lerp(lerp(c.x, c.y, f.x), lerp(d.x, d.y, f.x), f.y);
    return 0.5 * lerp(near, far, f.z);
}

// Four neighbours along x, from the one below.
fn quad(chunk: u32, n: u32) -> vec4<f32> {
    let a = word(chunk, n >> 1u);
    let b = word(chunk, (n >> 1u) + 1u);
    if ((n & 1u) == 0u) {
        return vec4<f32>(low_half(a), high_half(a), low_half(b), high_half(b));
    }
    return vec4<f32>(high_half(a), low_half(b), high_half(b), low_half(word(chunk, (n >> 1u) + 2u)));
}

// Gradient [stored units per index], in the grid's axes: central differences at the cell's corners, interpolated.
fn gradient_by_index(place: Place) -> vec3<f32> {
    let o = place.corner;
    let f = place.fraction;
    let k = place.chunk;
    let a = quad(k, o - 1u);
    let b = quad(k, o + ROW - 1u);
    let c = quad(k, o + SLICE - 1u);
    let d = quad(k, o + SLICE + ROW - 1u);
    let x = plane(a.zw - a.xy, b.zw - b.xy, c.zw - c.xy, d.zw - d.xy, f);
    let y = plane(
        b.yz - pair(k, o - ROW), pair(k, o + 2u * ROW) - a.yz,
        d.yz - pair(k, o + SLICE - ROW), pair(k, o + SLICE + 2u * ROW) - c.yz, f);
    let z = plane(
        c.yz - pair(k, o - SLICE), d.yz - pair(k, o + ROW - SLICE),
        pair(k, o + 2u * SLICE) - a.yz, pair(k, o + 2u * SLICE + ROW) - b.yz, f);
    return vec3<f32>(x, y, z);
}
