// An ultrasound fan: the twin of raycast's ultrasound.rs, in passes over its samples, its lines and the picture's pixels. Each pass is a shader of its own.

struct Fan {
    last: vec3<f32>,
    slope: f32,
    per_mm: vec3<f32>,
    intercept: f32,
    // index -> cells of scatterers
    per_cell: vec3<f32>,
    // log2 of what a sample lets through: this times the attenuation, and `through` times that of 1 - rho2
    loss: f32,
    lines: u32,
    samples: u32,
    // half the length over which an interface is looked for [samples]
    interface_reach: u32,
    gel: u32,
    pulse_weights: u32,
    through: f32,
    per_octave: f32,
    last_sample: f32,
    size: vec2<u32>,
    left: f32,
    top: f32,
    top_less_radius: f32,
    radius: f32,
    mm_per_pixel: f32,
    samples_per_mm: f32,
    per_radian: f32,
    middle: f32,
    unused: vec2<f32>,
}

@group(0) @binding(0) var<uniform> fan: Fan;

#if GATHER|ECHO
// place on the face, and way to the next sample, of each line [index]
@group(0) @binding(12) var<storage, read> ways: array<vec4<f32>>;

fn within(p: vec3<f32>) -> bool {
    return all(p >= vec3<f32>(0.0)) && all(p <= fan.last);
}
#end
#if PULSE|BEAM
// for each sample its grey, reach and weights across lines; then the pulse's weights
@group(0) @binding(13) var<storage, read> weights: array<f32>;
#end

#if GATHER
// Impedance, attenuation, scatter and value of every sample, and where it lies at rest.
@group(0) @binding(7) var<storage, read_write> tissues: array<vec4<f32>>;
@group(0) @binding(15) var<storage, read_write> places: array<vec4<f32>>;

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let count = fan.samples + fan.interface_reach;
    if (id.x >= count || id.y >= fan.lines) {
        return;
    }
    var p = fma(ways[2u * id.y + 1u].xyz, vec3<f32>(f32(id.x) + 0.5), ways[2u * id.y].xyz);
#if WARP
    p = rest_index(p);
#end
    var hu = AIR_HU;
    if (within(p)) {
        hu = value(locate(p)) * fan.slope + fan.intercept;
    }
    let n = id.y * count + id.x;
    tissues[n] = vec4<f32>(acoustic(hu), hu);
    places[n] = vec4<f32>(p, 0.0);
}
#end

#if WALK
// What is left of the sound at every sample of a line: by it the echo of an interface, and that of scatterers.
@group(0) @binding(7) var<storage, read> tissues: array<vec4<f32>>;
@group(0) @binding(14) var<storage, read_write> parts: array<vec2<f32>>;

// log2(1 - x), also where x is so small that 1 - x is 1.
fn log2_less(x: f32) -> f32 {
    if (x < 1e-3) {
        return -1.442695 * x * (1.0 + x * (0.5 + x / 3.0));
    }
    return log2(max(1.0 - x, LEAST_PASS));
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= fan.lines) {
        return;
    }
    let reach = fan.interface_reach;
    let first = id.x * (fan.samples + reach);
    var skin = 0u;
    for (var n = 0u; n < fan.gel; n++) {
        if (tissues[first + n].w > GAS_HU) {
            skin = n;
            break;
        }
    }
    var left = 0.0;
    for (var n = 0u; n < fan.samples; n++) {
        var own = vec2<f32>(0.0);
        if (n >= skin) {
            own = tissues[first + n].yz;
        }
        var before = GEL;
        if (n >= reach + skin) {
            before = tissues[first + n - reach].x;
        }
        var behind = GEL;
        if (n + reach >= skin) {
            behind = tissues[first + n + reach].x;
        }
        let rho = abs((behind - before) / (behind + before));
        let passed = 0.5 * (fan.through * log2_less(rho * rho) + fan.loss * own.x);
        let here = exp2(left + passed);
        left += 2.0 * passed;
        parts[id.x * fan.samples + n] = vec2<f32>(select(0.0, here * rho, rho > FAINT), here * own.y);
    }
}
#end

#if ECHO
@group(0) @binding(14) var<storage, read> parts: array<vec2<f32>>;
@group(0) @binding(15) var<storage, read> places: array<vec4<f32>>;
// of interfaces, and of scatterers as a complex number
@group(0) @binding(7) var<storage, read_write> echoes: array<vec4<f32>>;

#if SPECKLE
// pcg3d
fn hash(cell: vec3<u32>) -> vec3<u32> {
    var v = cell * 1664525u + 1013904223u;
    v.x += v.y * v.z;
    v.y += v.z * v.x;
    v.z += v.x * v.y;
    v = v ^ (v >> vec3<u32>(16u));
    v.x += v.y * v.z;
    v.y += v.z * v.x;
    v.z += v.x * v.y;
    return v;
}

// A complex Gaussian number of unit power for a place [cells], continuous in it.
fn scatterer(at: vec3<f32>) -> vec2<f32> {
    let first = floor(at);
    let upper = at - first;
    let lower = 1.0 - upper;
    let cell = bitcast<vec3<u32>>(vec3<i32>(first));
    var sum = vec2<f32>(0.0);
    for (var corner = 0u; corner < 8u; corner++) {
        let bits = vec3<u32>(corner & 1u, (corner >> 1u) & 1u, corner >> 2u);
        let weight = select(lower, upper, bits == vec3<u32>(1u));
        let number = vec2<f32>(countOneBits(hash(cell + bits).xy));
        sum += weight.x * weight.y * weight.z * (number - 16.0) * 0.25;
    }
    let power = lower * lower + upper * upper;
    return sum / sqrt(power.x * power.y * power.z);
}
#end

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= fan.samples || id.y >= fan.lines) {
        return;
    }
    let n = id.y * fan.samples + id.x;
    let part = parts[n];
    let p = places[id.y * (fan.samples + fan.interface_reach) + id.x].xyz;
    var mirror = part.x;
    if (mirror > 0.0 && within(p)) {
        let g = gradient_by_index(locate(p));
        let along = dot(g, ways[2u * id.y + 1u].xyz) * fan.samples_per_mm;
        let square = dot(g * fan.per_mm, g * fan.per_mm);
        if (square > 0.0) {
            mirror *= along * along / square;
        }
    }
    var speckle = vec2<f32>(0.0);
#if SPECKLE
    if (part.y > 0.0) {
        speckle = part.y * scatterer(p * fan.per_cell);
    }
#end
    echoes[n] = vec4<f32>(mirror, speckle, 0.0);
}
#end

#if PULSE
// Scatterers over the pulse's length.
@group(0) @binding(7) var<storage, read> echoes: array<vec4<f32>>;
@group(0) @binding(15) var<storage, read_write> blurred: array<vec4<f32>>;

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= fan.samples || id.y >= fan.lines) {
        return;
    }
    let row = id.y * fan.samples;
    var speckle = vec2<f32>(0.0);
#if SPECKLE
    let reach = fan.pulse_weights - 1u;
    let end = min(id.x + reach, fan.samples - 1u);
    for (var m = max(id.x, reach) - reach; m <= end; m++) {
        let far = max(m, id.x) - min(m, id.x);
        speckle += weights[fan.samples * WEIGHTS + far] * echoes[row + m].yz;
    }
#end
    blurred[row + id.x] = vec4<f32>(echoes[row + id.x].x, speckle, 0.0);
}
#end

#if BEAM
// All echoes over the beam's width, and their grey.
@group(0) @binding(15) var<storage, read> blurred: array<vec4<f32>>;
@group(0) @binding(14) var<storage, read_write> greys: array<vec2<f32>>;

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= fan.samples || id.y >= fan.lines) {
        return;
    }
    let row = id.x * WEIGHTS;
    let reach = u32(weights[row + 1u]);
    let end = min(id.y + reach, fan.lines - 1u);
    var sum = 0.0;
    var squares = 0.0;
    var all = vec3<f32>(0.0);
    for (var line = max(id.y, reach) - reach; line <= end; line++) {
        let w = weights[row + 2u + max(line, id.y) - min(line, id.y)];
        sum += w;
        squares += w * w;
        all += w * blurred[line * fan.samples + id.x].xyz;
    }
    let speckle = all.yz / sqrt(squares);
    let echo = length(vec2<f32>(all.x / sum + speckle.x, speckle.y));
    let grey = weights[row] + fan.per_octave * log2(max(echo, LEAST_ECHO));
    greys[id.y * fan.samples + id.x] = vec2<f32>(clamp(grey, 0.0, 1.0), 0.0);
}
#end

#if SCAN
@group(0) @binding(14) var<storage, read> greys: array<vec2<f32>>;
@group(0) @binding(1) var<storage, read_write> colors: array<u32>;

// Arc tangent from 0 to 1 within 2e-8 [Abramowitz & Stegun, 4.4.49]: a device's own may be a thousand times less exact.
fn arc_of(t: f32) -> f32 {
    let s = t * t;
    var sum = 0.0028662257;
    sum = fma(sum, s, -0.0161657367);
    sum = fma(sum, s, 0.0429096138);
    sum = fma(sum, s, -0.07528964);
    sum = fma(sum, s, 0.1065626393);
    sum = fma(sum, s, -0.1420889944);
    sum = fma(sum, s, 0.1999355085);
    sum = fma(sum, s, -0.3333314528);
    return fma(sum * s, t, t);
}

// Angle from the fan's axis; y is above 0.
fn angle_of(x: f32, y: f32) -> f32 {
    let across = abs(x);
    var angle = 0.0;
    if (across <= y) {
        angle = arc_of(across / y);
    } else {
        angle = 1.5707963 - arc_of(y / across);
    }
    return select(angle, -angle, x < 0.0);
}

fn grey_at(line: u32, n: u32) -> f32 {
    return greys[line * fan.samples + min(n, fan.samples - 1u)].x;
}

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= fan.size.x || id.y >= fan.size.y) {
        return;
    }
    let x = fma(f32(id.x), fan.mm_per_pixel, fan.left);
    let y = fma(f32(id.y), fan.mm_per_pixel, fan.top);
    let line = fma(angle_of(x, y), fan.per_radian, fan.middle);
    // what lies beyond the face is a difference of squares: nothing is lost for a face of large curvature
    let less = fma(f32(id.y), fan.mm_per_pixel, fan.top_less_radius);
    let depth = fma(less, y + fan.radius, x * x) / (sqrt(fma(x, x, y * y)) + fan.radius);
    let n = depth * fan.samples_per_mm - 0.5;
    var grey = 0.0;
    if (line >= 0.0 && line <= 2.0 * fan.middle && n >= 0.0 && n <= fan.last_sample) {
        let l = min(u32(line), fan.lines - 2u);
        let s = min(u32(n), max(fan.samples, 2u) - 2u);
        let v = n - f32(s);
        let one = mix(grey_at(l, s), grey_at(l, s + 1u), v);
        let two = mix(grey_at(l + 1u, s), grey_at(l + 1u, s + 1u), v);
        grey = mix(one, two, line - f32(l));
    }
    let byte = u32(255.0 * grey + 0.5);
    colors[id.y * fan.size.x + id.x] = byte * 0x010101u | 0xff000000u;
}
#end
