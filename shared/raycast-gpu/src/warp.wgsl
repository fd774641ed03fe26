// Rays through a warp: the look-up of raycast's warp/lattice.rs, asked at every sample; the reference's lattice of a picture, which spares a
// CPU these questions, is not needed here and adds an error that this has not.

struct Lattice {
    origin: vec3<f32>,
    // cells of the skip map by which anything may be moved
    cells: f32,
    per_pitch: vec3<f32>,
    nothing: f32,
    spacing: vec3<f32>,
    unused: f32,
    // largest |∂v_c/∂x_d| [index per index], a row for each c
    steepest: array<vec4<f32>, 3>,
    counts: vec4<u32>,
}

@group(0) @binding(5) var<uniform> lattice: Lattice;
@group(0) @binding(6) var<storage, read> nodes: array<vec4<f32>>;

// Weights of four nodes in a row for a place between the second and the third (Lagrange).
fn cubic(t: f32) -> vec4<f32> {
    let a = t + 1.0;
    let b = t - 1.0;
    let c = t - 2.0;
    return vec4<f32>(-t * b * c / 6.0, a * b * c / 2.0, -a * t * c / 2.0, a * t * b / 6.0);
}

struct Cell {
    first: vec3<u32>,
    place: vec3<f32>,
}

fn cell_at(p: vec3<f32>) -> Cell {
    let held = clamp((p - lattice.origin) * lattice.per_pitch, vec3<f32>(0.0), vec3<f32>(lattice.counts.xyz - 1u));
    let first = min(max(vec3<u32>(held), vec3<u32>(1u)) - 1u, lattice.counts.xyz - 4u);
    return Cell(first, held - vec3<f32>(first) - 1.0);
}

// v [index] at a position of world space [index], under weights for each axis.
fn weighted(first: vec3<u32>, x: vec4<f32>, y: vec4<f32>, z: vec4<f32>) -> vec3<f32> {
    let row = lattice.counts.x;
    let slice = row * lattice.counts.y;
    var sum = vec3<f32>(0.0);
    for (var k = 0u; k < 4u; k++) {
        var plane_sum = vec3<f32>(0.0);
        for (var j = 0u; j < 4u; j++) {
            let n = (first.z + k) * slice + (first.y + j) * row + first.x;
            let line = nodes[n].xyz * x.x + nodes[n + 1u].xyz * x.y + (nodes[n + 2u].xyz * x.z + nodes[n + 3u].xyz * x.w);
            plane_sum = fma(line, vec3<f32>(y[j]), plane_sum);
        }
        sum = fma(plane_sum, vec3<f32>(z[k]), sum);
    }
    return sum;
}

fn offset_at(p: vec3<f32>) -> vec3<f32> {
    let c = cell_at(p);
    return weighted(c.first, cubic(c.place.x), cubic(c.place.y), cubic(c.place.z));
}

#if RAYS
// No axis of rest space moves faster than this along the ray [index per step].
fn speed_of(ray: Ray) -> vec3<f32> {
    let d = abs(ray.delta);
    return d + vec3<f32>(dot(lattice.steepest[0].xyz, d), dot(lattice.steepest[1].xyz, d), dot(lattice.steepest[2].xyz, d));
}

// Rest position of the sample at q.
fn bent(ray: Ray, q: f32) -> vec3<f32> {
    let p = at(ray, q);
    return p + offset_at(p);
}

#if SHADED
// The weights' slopes.
fn cubic_slope(t: f32) -> vec4<f32> {
    let tt = 3.0 * t * t;
    return vec4<f32>(-(tt - 6.0 * t + 2.0) / 6.0, (tt - 4.0 * t - 1.0) / 2.0, -(tt - 2.0 * t - 2.0) / 2.0, (tt - 1.0) / 6.0);
}

// A gradient of rest space [per mm], as world space sees it at p: (1 + ∂v/∂x)ᵀ g.
fn turned(g: vec3<f32>, p: vec3<f32>) -> vec3<f32> {
    let c = cell_at(p);
    let x = cubic(c.place.x);
    let y = cubic(c.place.y);
    let z = cubic(c.place.z);
    let weight = g * lattice.spacing;
    let along = vec3<f32>(
        dot(weight, weighted(c.first, cubic_slope(c.place.x), y, z)),
        dot(weight, weighted(c.first, x, cubic_slope(c.place.y), z)),
        dot(weight, weighted(c.first, x, y, cubic_slope(c.place.z))));
    return g + along * lattice.per_pitch / lattice.spacing;
}
#end
#end
