// Labels of organs: a byte a voxel, nearest neighbour; the twin of raycast's labels.rs.

@group(0) @binding(8) var<storage, read> labels: array<u32>;
// r, g, b and share of each label, then factors of extinction, four to a vector
@group(0) @binding(9) var<uniform> label_colors: array<vec4<f32>, 320>;

fn label_near(p: vec3<f32>) -> u32 {
    let near = clamp(vec3<i32>(round(p)), vec3<i32>(0), vec3<i32>(SIZE_X - 1, SIZE_Y - 1, SIZE_Z - 1));
    let n = u32((near.z * SIZE_Y + near.y) * SIZE_X + near.x);
    return (labels[n >> 2u] >> ((n & 3u) * 8u)) & 0xffu;
}

fn painted(entry: vec4<f32>, p: vec3<f32>) -> vec4<f32> {
    let label = label_near(p);
    let own = label_colors[label];
    let factor = label_colors[256u + (label >> 2u)][label & 3u];
    return vec4<f32>((own.xyz - entry.xyz) * own.w + entry.xyz, entry.w * factor);
}
