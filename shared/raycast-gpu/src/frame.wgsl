// The numbers of a frame, and rays: the twin of raycast's frame.rs.

struct Frame {
    eye: vec3<f32>,
    step: f32,
    forward: vec3<f32>,
    aspect: f32,
    right: vec3<f32>,
    barrel: f32,
    down: vec3<f32>,
    opaque: f32,
    per_mm: vec3<f32>,
    value_scale: f32,
    margin: vec3<f32>,
    value_offset: f32,
    last: vec3<f32>,
    threshold: f32,
    light: vec3<f32>,
    falloff: f32,
    surface: vec3<f32>,
    water: f32,
    background: vec3<f32>,
    shade_from: f32,
    lens: vec4<f32>,
    // ambient · ambient light, diffuse, specular
    shading: vec3<f32>,
    power: u32,
    // heaviest, lightest, shortest, longest
    pieces: vec4<f32>,
    size: vec2<u32>,
    entries: u32,
    unused: u32,
}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read_write> colors: array<u32>;
#if DEPTH
@group(0) @binding(2) var<storage, read_write> depths: array<f32>;
#end

struct Ray {
    origin: vec3<f32>,
    delta: vec3<f32>,
    direction: vec3<f32>,
    length: f32,
    start: f32,
}

fn ray_through(pixel: vec2<u32>) -> Ray {
    var uv = vec2<f32>(pixel) * frame.lens.xy + frame.lens.zw;
#if BARREL
    let wide = uv * vec2<f32>(frame.aspect, 1.0);
    uv = uv * ((1.0 + frame.barrel * dot(wide, wide)) / (1.0 + frame.barrel));
#end
    var direction = frame.forward + uv.x * frame.right + uv.y * frame.down;
    direction = direction * (1.0 / sqrt(dot(direction, direction)));
    var per_mm = direction * frame.per_mm;
    per_mm = select(per_mm, vec3<f32>(TINY), abs(per_mm) < vec3<f32>(TINY));
    let a = (-frame.margin - frame.eye) / per_mm;
    let b = (frame.last + frame.margin - frame.eye) / per_mm;
    let low = min(a, b);
    let high = max(a, b);
    let enter = max(max(0.0, low.x), max(low.y, low.z));
    let leave = min(high.x, min(high.y, high.z));
    return Ray(frame.eye + enter * per_mm, per_mm * frame.step, direction, (leave - enter) / frame.step, enter);
}

// Position q steps from where the ray enters.
fn at(ray: Ray, q: f32) -> vec3<f32> {
    return fma(ray.delta, vec3<f32>(q), ray.origin);
}

fn write_pixel(pixel: u32, color: vec3<f32>, transmittance: f32, behind: vec3<f32>) {
    let v = clamp((color + transmittance * behind) * 255.0 + 0.5, vec3<f32>(0.0), vec3<f32>(255.0));
    let bytes = vec3<u32>(v);
    colors[pixel] = bytes.x | (bytes.y << 8u) | (bytes.z << 16u) | 0xff000000u;
}
