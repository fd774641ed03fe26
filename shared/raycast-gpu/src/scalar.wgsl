// One ray an invocation: the twin of raycast's scalar.rs (of walk.rs where there is a warp).

#if TABLE
@group(0) @binding(10) var<storage, read> table: array<vec4<f32>>;
#end
#if ENDS
// the nearest solid body of each pixel: colour, distance from the eye [mm]
@group(0) @binding(11) var<storage, read> solids: array<vec4<f32>>;
#end

fn rest_at(ray: Ray, q: f32) -> vec3<f32> {
#if WARP
    return bent(ray, q);
#else
    return at(ray, q);
#end
}

#if SURFACE
fn miss(ray: Ray, q: f32) -> f32 {
    return value(locate(rest_at(ray, q))) * frame.value_scale + frame.value_offset - frame.threshold;
}

// Where the threshold is crossed between q − 1 and q [steps] (Illinois regula falsi).
fn refine(ray: Ray, q: f32, at_q: f32) -> f32 {
    var a = q - 1.0;
    var b = q;
    var at_a = min(miss(ray, a), -1e-6);
    var at_b = at_q - frame.threshold;
    for (var n = 0; n < REFINEMENTS; n++) {
        let middle = a + (b - a) * (at_a / (at_a - at_b));
        let v = miss(ray, middle);
        if (v >= 0.0) {
            b = middle;
            at_b = v;
            at_a = at_a * 0.5;
        } else {
            a = middle;
            at_a = v;
            at_b = at_b * 0.5;
        }
    }
    return b;
}
#end

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= frame.size.x || id.y >= frame.size.y) {
        return;
    }
    let pixel = id.y * frame.size.x + id.x;
    var ray = ray_through(id.xy);
    var behind = frame.background;
#if ENDS
    let solid = solids[pixel];
    let ends = solid.w < FAR;
    if (ends) {
        ray.length = min(ray.length, (solid.w - ray.start) / frame.step);
        behind = solid.xyz;
    }
#end
#if WARP
    let speed = speed_of(ray);
    let fastest = max(speed.x, max(speed.y, speed.z));
    // whether the warp had the ray out of the volume a moment ago
    var edge = false;
#end
    var color = vec3<f32>(0.0);
    var transmittance = 1.0;
    var depth = FAR;
#if XRAY
    var attenuation = 0.0;
#end
#if TABLE
    var shaded = false;
    var factors = vec2<f32>(1.0, 0.0);
#end
    // the piece of ray that comes next: its beginning and length [steps]
    var begin = 0.0;
    var piece = 1.0;
    loop {
        var stop = ray.length <= 0.5;
#if ENDS
        if (ends) {
            let left = ray.length - begin;
            stop = left <= LAST_PIECE;
#if ISOSURFACE
            piece = min(piece, 2.0 * left);
#else
            piece = min(piece, left);
#end
        }
#end
        let q = begin + 0.5 * piece;
        if (stop || !(q <= ray.length)) {
            break;
        }
#if WARP
        // what is empty however the warp moves it is jumped over without asking the warp
        var p = at(ray, q);
        var cell = cell_of(p) / CELL;
        var state = state_of(cell);
        var d = f32(state) - lattice.cells;
        let certain = d > 1.0 && state != GENTLE;
        var way_out = 0.0;
        var fresh = false;
        var empty = certain;
        if (certain) {
            way_out = box_exit(ray.delta, d, cell, p);
            edge = false;
        } else {
            p = bent(ray, q);
            cell = cell_of(p) / CELL;
            state = state_of(cell);
            let beyond = max(-p, p - frame.last) / speed;
            let gap = max(beyond.x, max(beyond.y, beyond.z));
            let outside = gap > 0.0;
            // matter met right after what is outside is cut open, as at the start of a ray
            fresh = edge && !outside;
            edge = outside;
            empty = outside || (state != 0u && state != GENTLE);
            if (outside) {
                way_out = gap;
            } else if (empty) {
                way_out = (f32(state) - 1.0) * f32(CELL) / fastest;
            }
#if EXACT
            // from where the lattice leads, to where it leads
            way_out = way_out - 2.0 * lattice.astray / fastest;
#end
        }
#else
        let p = at(ray, q);
        let cell = cell_of(p) / CELL;
        let state = state_of(cell);
        let empty = state != 0u && state != GENTLE;
        var way_out = 0.0;
        if (empty) {
            way_out = box_exit(ray.delta, f32(state), cell, p);
        }
#end
        if (empty) {
            // as if the ray went on by one step at a time
            let after = begin + max(piece, 1.0);
            begin = after - 1.0 + max(ceil(q + way_out - (1e-3 - 0.5) - after), 1.0);
            piece = 1.0;
#if TABLE
            shaded = false;
#end
            continue;
        }
        let place = locate(p);
        let v = value(place) * frame.value_scale + frame.value_offset;
#if SURFACE
        if (v >= frame.threshold) {
            var cut = q < 0.75;
#if WARP
            cut = cut || fresh;
#end
            var hit = q;
            var light = cut_open();
            if (!cut) {
                hit = refine(ray, q, v);
                light = shade(ray, locate(rest_at(ray, hit)), hit);
            }
            color += transmittance * (frame.surface * light.x + light.y);
            if (transmittance > 0.5) {
                depth = ray.start + hit * frame.step;
            }
            transmittance = 0.0;
            break;
        }
#end
#if TABLE
        var entry = table[min(u32(max(v, 0.0)), frame.entries - 1u)];
#if LABELS
        entry = painted(entry, p);
#end
        let weight = transmittance * (1.0 - exp2(entry.w * piece));
#if PIECES
        if (weight > frame.pieces.x && piece > frame.pieces.z) {
            piece = piece * 0.5;
            continue;
        }
        begin += piece;
        let longest = select(1.0, frame.pieces.w, state == GENTLE);
        piece = min(select(piece, 2.0 * piece, weight < frame.pieces.y), longest);
#else
        begin += piece;
        piece = 1.0;
#end
        if (weight > 0.0) {
            if (!shaded || weight >= frame.shade_from) {
                factors = shade(ray, place, q);
                shaded = true;
            }
            color += weight * (entry.xyz * factors.x + factors.y);
            let left = transmittance - weight;
            if (transmittance >= 0.5 && left < 0.5) {
                depth = ray.start + q * frame.step;
            }
            transmittance = left;
            if (left < frame.opaque) {
                color = color * (1.0 / (1.0 - left));
                transmittance = 0.0;
                break;
            }
        }
#end
#if ISOSURFACE
        begin += 1.0;
#end
#if XRAY
        attenuation += frame.water * frame.step * piece * max(1.0 + v * 1e-3, 0.0);
        begin += 1.0;
#end
    }
#if XRAY
    transmittance = exp(-attenuation);
    color = vec3<f32>(1.0 - transmittance);
#end
    write_pixel(pixel, color, transmittance, behind);
#if DEPTH
#if ENDS
    if (ends && transmittance > 0.5) {
        depth = solid.w;
    }
#end
    depths[pixel] = depth;
#end
}
