// A pixel of a section an invocation: the twin of raycast's section.rs.

struct Section {
    // continuous index of pixel (0, 0), and its change by a pixel across, one down, and through the whole slab
    corner: vec3<f32>,
    gain: f32,
    across: vec3<f32>,
    level: f32,
    down: vec3<f32>,
    slope: f32,
    through: vec3<f32>,
    intercept: f32,
    last: vec3<f32>,
    planes: f32,
    // a displacement [index] ↦ millimetres to the picture's right and bottom
    right_mm: vec3<f32>,
    opaque_mm: f32,
    down_mm: vec3<f32>,
    unused: f32,
    size: vec2<u32>,
    nothing: vec2<u32>,
}

@group(0) @binding(0) var<uniform> view: Section;
@group(0) @binding(1) var<storage, read_write> colors: array<u32>;

fn rest_of(p: vec3<f32>) -> vec3<f32> {
#if WARP
    return rest_index(p);
#else
    return p;
#end
}

fn tinted(bytes: vec3<f32>, color: vec3<f32>, share: f32) -> vec3<f32> {
    return floor(bytes + (255.0 * color - bytes) * clamp(share, 0.0, 1.0) + 0.5);
}

#if OVERLAY
fn hue(turns: f32) -> vec3<f32> {
    let k = (vec3<f32>(5.0, 3.0, 1.0) + fract(turns) * 6.0) % vec3<f32>(6.0);
    return 1.0 - clamp(min(k, 4.0 - k), vec3<f32>(0.0), vec3<f32>(1.0));
}
#end

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= view.size.x || id.y >= view.size.y) {
        return;
    }
    let middle = view.corner + f32(id.x) * view.across + f32(id.y) * view.down;
    var sum = 0.0;
    var most = -FAR;
    var count = 0.0;
    for (var n = 0.0; n < view.planes; n += 1.0) {
        var p = middle;
#if SLAB
        p += view.through * (n / (view.planes - 1.0) - 0.5);
#end
        p = rest_of(p);
        if (all(p >= vec3<f32>(-NEARLY)) && all(p <= view.last + NEARLY)) {
            let v = value(locate(p)) * view.slope + view.intercept;
            sum += v;
            most = max(most, v);
            count += 1.0;
        }
    }
    var bytes = vec3<f32>(0.0);
    if (count > 0.0) {
#if MAXIMUM
        let v = most;
#else
        let v = sum / count;
#end
        bytes = vec3<f32>(floor(clamp((v - view.level) * view.gain + 128.0, 0.0, 255.0)));
#if LABELS
        let p = rest_of(middle);
        if (all(p >= vec3<f32>(-0.5)) && all(p < view.last + 0.5)) {
            let label = label_colors[label_near(p)];
            bytes = tinted(bytes, label.xyz, 0.5 * label.w);
        }
#end
#if OVERLAY
        let u = middle - rest_of(middle);
        let across = dot(u, view.right_mm);
        let up = -dot(u, view.down_mm);
        var turns = 0.0;
        if (across != 0.0 || up != 0.0) {
            turns = atan2(up, across) / 6.2831855;
        }
        bytes = tinted(bytes, hue(turns), length(vec2<f32>(across, up)) / view.opaque_mm);
#end
    }
    let whole = vec3<u32>(bytes);
    colors[id.y * view.size.x + id.x] = whole.x | (whole.y << 8u) | (whole.z << 16u) | 0xff000000u;
}
