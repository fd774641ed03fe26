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
#if EXACT
    // columns: volume index -> field index, and what is added; and back, vectors only
    to_field: array<vec4<f32>, 4>,
    to_volume: array<vec4<f32>, 3>,
    field_spacing: vec3<f32>,
    // what a step of a node of the field is worth [index of the field]
    scale: f32,
    // how far from where the lattice leads a place may be [index]
    astray: f32,
    // squared residual at which it is found [mm2]
    stop: f32,
    // numbers of the first cell and the first node of the field among all
    first_cell: u32,
    first_node: u32,
    field_size: vec4<u32>,
#end
}

@group(0) @binding(5) var<uniform> lattice: Lattice;
// the lattice's nodes; where the field itself is asked, a byte for each cell and two words for each of its nodes after them
@group(0) @binding(6) var<storage, read> nodes: array<vec4<u32>>;

fn node(n: u32) -> vec3<f32> {
    return bitcast<vec4<f32>>(nodes[n]).xyz;
}

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
            let line = node(n) * x.x + node(n + 1u) * x.y + (node(n + 2u) * x.z + node(n + 3u) * x.w);
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

#if EXACT
// What places ask where the lattice does not suffice: raycast's warp/exact.rs.
fn is_rough(x: vec3<f32>) -> bool {
    let at = max((x - lattice.origin) * lattice.per_pitch, vec3<f32>(0.0));
    let cell = min(vec3<u32>(at), lattice.counts.xyz - 2u);
    let n = (cell.z * (lattice.counts.y - 1u) + cell.y) * (lattice.counts.x - 1u) + cell.x;
    let four = nodes[lattice.first_cell + n / 16u][(n / 4u) % 4u];
    return ((four >> (8u * (n % 4u))) & 255u) != 0u;
}

fn field_index(p: vec3<f32>) -> vec3<f32> {
    return fma(vec3<f32>(p.x), lattice.to_field[0].xyz,
        fma(vec3<f32>(p.y), lattice.to_field[1].xyz, fma(vec3<f32>(p.z), lattice.to_field[2].xyz, lattice.to_field[3].xyz)));
}

fn field_node(n: u32) -> vec3<f32> {
    let two = nodes[lattice.first_node + n / 2u];
    let one = select(two.xy, two.zw, (n & 1u) == 1u);
    return vec3<f32>(f32(bitcast<i32>(one.x << 16u) >> 16u), f32(bitcast<i32>(one.x) >> 16u), f32(bitcast<i32>(one.y << 16u) >> 16u));
}

// u, and its derivatives by axis [field index].
struct Jet {
    u: vec3<f32>,
    x: vec3<f32>,
    y: vec3<f32>,
    z: vec3<f32>,
}

fn jet_at(p: vec3<f32>) -> Jet {
    let held = clamp(p, vec3<f32>(0.0), vec3<f32>(lattice.field_size.xyz - 1u));
    let base = min(vec3<u32>(held), lattice.field_size.xyz - 2u);
    let f = clamp(held - vec3<f32>(base), vec3<f32>(0.0), vec3<f32>(1.0));
    let row = lattice.field_size.x;
    let slice = row * lattice.field_size.y;
    let n = base.z * slice + base.y * row + base.x;
    let c0 = field_node(n);
    let c2 = field_node(n + row);
    let c4 = field_node(n + slice);
    let c6 = field_node(n + slice + row);
    let d0 = field_node(n + 1u) - c0;
    let d1 = field_node(n + row + 1u) - c2;
    let d2 = field_node(n + slice + 1u) - c4;
    let d3 = field_node(n + slice + row + 1u) - c6;
    let x = vec3<f32>(f.x);
    let y = vec3<f32>(f.y);
    let z = vec3<f32>(f.z);
    let e0 = fma(d0, x, c0);
    let e2 = fma(d2, x, c4);
    let near = fma(d1, x, c2) - e0;
    let far = fma(d3, x, c6) - e2;
    let g0 = fma(near, y, e0);
    let g1 = fma(far, y, e2);
    let h0 = fma(d1 - d0, y, d0);
    let h1 = fma(d3 - d2, y, d2);
    return Jet(fma(g1 - g0, z, g0) * lattice.scale, fma(h1 - h0, z, h0) * lattice.scale, fma(far - near, z, near) * lattice.scale, (g1 - g0) * lattice.scale);
}

// Solves (1 + J) d = r; where the cell is nearly folded d = r.
fn newton(jet: Jet, r: vec3<f32>) -> vec3<f32> {
    let x = jet.x + vec3<f32>(1.0, 0.0, 0.0);
    let y = jet.y + vec3<f32>(0.0, 1.0, 0.0);
    let z = jet.z + vec3<f32>(0.0, 0.0, 1.0);
    let yz = cross(y, z);
    let determinant = dot(x, yz);
    if (abs(determinant) < FOLDED) {
        return r;
    }
    return vec3<f32>(dot(yz, r), dot(cross(z, x), r), dot(cross(x, y), r)) / determinant;
}

#if SHADED
// A gradient of rest space [per mm] at p, as world space sees it: (1 + du/dX)^-T g.
fn turned_exactly(g: vec3<f32>, p: vec3<f32>) -> vec3<f32> {
    let jet = jet_at(field_index(p));
    let by_index = g / frame.per_mm;
    let own = vec3<f32>(dot(lattice.to_volume[0].xyz, by_index), dot(lattice.to_volume[1].xyz, by_index), dot(lattice.to_volume[2].xyz, by_index));
    let x = jet.x + vec3<f32>(1.0, 0.0, 0.0);
    let y = jet.y + vec3<f32>(0.0, 1.0, 0.0);
    let z = jet.z + vec3<f32>(0.0, 0.0, 1.0);
    let yz = cross(y, z);
    let determinant = dot(x, yz);
    var out = own;
    if (abs(determinant) >= FOLDED) {
        out = (own.x * yz + own.y * cross(z, x) + own.z * cross(x, y)) / determinant;
    }
    return vec3<f32>(dot(lattice.to_field[0].xyz, out), dot(lattice.to_field[1].xyz, out), dot(lattice.to_field[2].xyz, out)) * frame.per_mm;
}
#end

// The rest position p of x [index], nearer to the true one.
fn settled(x: vec3<f32>, p: vec3<f32>) -> vec3<f32> {
    let goal = field_index(x);
    let start = field_index(p);
    var at = start;
    var jet = jet_at(at);
    var r = goal - at - jet.u;
    var square = dot(r * lattice.field_spacing, r * lattice.field_spacing);
    var step = newton(jet, r);
    var share = 1.0;
    for (var n = 1; n < LOOKS; n++) {
        if (square <= lattice.stop || share <= SHORTEST) {
            break;
        }
        let tried = fma(vec3<f32>(share), step, at);
        jet = jet_at(tried);
        r = goal - tried - jet.u;
        let off = dot(r * lattice.field_spacing, r * lattice.field_spacing);
        if (off < square) {
            at = tried;
            square = off;
            step = newton(jet, r);
            share = 1.0;
        } else {
            share = share * 0.5;
        }
    }
    let moved = at - start;
    return p + moved.x * lattice.to_volume[0].xyz + moved.y * lattice.to_volume[1].xyz + moved.z * lattice.to_volume[2].xyz;
}
#end

// Rest position of a place in world space [index].
fn rest_index(x: vec3<f32>) -> vec3<f32> {
    let p = x + offset_at(x);
#if EXACT
    if (is_rough(x)) {
        return settled(x, p);
    }
#end
    return p;
}

#if RAYS
// No axis of rest space moves faster than this along the ray [index per step].
fn speed_of(ray: Ray) -> vec3<f32> {
    let d = abs(ray.delta);
    return d + vec3<f32>(dot(lattice.steepest[0].xyz, d), dot(lattice.steepest[1].xyz, d), dot(lattice.steepest[2].xyz, d));
}

// Rest position of the sample at q.
fn bent(ray: Ray, q: f32) -> vec3<f32> {
    return rest_index(at(ray, q));
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
