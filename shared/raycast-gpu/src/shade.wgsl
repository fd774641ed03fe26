// Light.

#if SHADED
// Gradient [stored units/mm], in the grid's axes.
fn gradient(place: Place) -> vec3<f32> {
    return gradient_by_index(place) * frame.per_mm;
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
