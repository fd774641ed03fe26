// Gradients and light.

#if SHADED
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

// Gradient [stored units/mm], in the grid's axes: central differences at the cell's corners, interpolated.
fn gradient(place: Place) -> vec3<f32> {
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
    return vec3<f32>(x, y, z) * frame.per_mm;
}

// Factors of colour and highlight at a sample.
fn shade(ray: Ray, place: Place, q: f32) -> vec2<f32> {
    var g = gradient(place);
#if WARP
#if EXACT
    g = turned_exactly(g, rest_index(at(ray, q)));
#else
    g = turned(g, at(ray, q));
#end
#end
    let square = dot(g, g);
#if AT_EYE
    let light = ray.direction;
#else
    let light = frame.light;
#end
    var cosine = 0.0;
    var highlight = 0.0;
    if (square > ZERO_GRADIENT) {
        cosine = min(abs(dot(g, light)) / sqrt(square), 1.0);
        highlight = frame.shading.z;
        var factor = cosine;
        for (var power = frame.power; power != 0u; power = power >> 1u) {
            if ((power & 1u) == 1u) {
                highlight = highlight * factor;
            }
            factor = factor * factor;
        }
    }
    let both = vec2<f32>(frame.shading.x + frame.shading.y * cosine, highlight);
#if AT_EYE
    let distance = ray.start + q * frame.step;
    return both * (1.0 / (1.0 + distance * distance * frame.falloff));
#else
    return both;
#end
}
#else
fn shade(ray: Ray, place: Place, q: f32) -> vec2<f32> {
    return vec2<f32>(1.0, 0.0);
}
#end

#if SURFACE
// Shading of matter cut open: as if facing the light.
fn cut_open() -> vec2<f32> {
#if SHADED
    return vec2<f32>(frame.shading.x + frame.shading.y, 0.0);
#else
    return vec2<f32>(1.0, 0.0);
#end
}
#end
