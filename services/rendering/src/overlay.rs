//! The tool in the 3D view: a capsule (tip and shaft), behind what lies before it.
//!
//! Each pixel's ray is intersected with the capsule in closed form (sphere at the tip, cylinder along the shaft) and
//! compared with the picture's depth. Frame: patient, mm. Cost: a few dozen operations a pixel of the picture.

use maille_contract::{ToolState, messages::TOOL_IN_CONTACT};
use maille_raycast::{Camera, Picture};
use nalgebra::Vector3;

type V3 = Vector3<f64>;

/// Length of shaft that is drawn [mm].
const SHAFT_MM: f64 = 180.0;

/// Draws the tool into a picture that has depth.
pub(crate) fn draw_tool(picture: &mut Picture, camera: &Camera, tool: &ToolState) {
    let Some(direction) = V3::from(tool.direction).try_normalize(1e-9) else { return };
    if camera.fault().is_some() || !tool.tip_mm.iter().all(|v| v.is_finite()) {
        return;
    }
    let [forward, right, up] = camera.frame();
    let (w, h) = (picture.width, picture.height);
    let scale = 2.0 * (camera.fov_deg.to_radians() / 2.0).tan() / h as f64;
    let (eye, tip) = (V3::from(camera.eye), V3::from(tool.tip_mm));
    let color = if tool.flags & TOOL_IN_CONTACT != 0 { [1.0, 0.55, 0.2] } else { [0.75, 0.8, 0.88] };
    let Picture { rgb, depth: Some(depth), .. } = picture else { return };
    for y in 0..h {
        for x in 0..w {
            let (u, v) = ((x as f64 + 0.5 - w as f64 / 2.0) * scale, (h as f64 / 2.0 - y as f64 - 0.5) * scale);
            let ray = (forward + right * u + up * v).normalize();
            let Some((t, normal)) = hit(eye, ray, tip, -direction, tool.radius_mm) else { continue };
            let at = y * w + x;
            if t as f32 <= depth[at] {
                let light = 0.25 + 0.75 * normal.dot(&ray).abs();
                for c in 0..3 {
                    rgb[3 * at + c] = (255.0 * (color[c] * light).min(1.0)) as u8;
                }
                depth[at] = t as f32;
            }
        }
    }
}

/// First hit of a ray (unit direction) with the capsule that begins at `tip` and runs along `axis` (unit): distance and normal.
fn hit(eye: V3, ray: V3, tip: V3, axis: V3, radius: f64) -> Option<(f64, V3)> {
    let from = eye - tip;
    // the cylinder: both ray and offset without their part along the axis
    let (d, o) = (ray - axis * ray.dot(&axis), from - axis * from.dot(&axis));
    let on_shaft = root(d.norm_squared(), o.dot(&d), o.norm_squared() - radius * radius)
        .map(|t| (t, from.dot(&axis) + t * ray.dot(&axis)))
        .filter(|&(_, along)| (0.0..=SHAFT_MM).contains(&along))
        .map(|(t, along)| (t, (from + ray * t - axis * along) / radius));
    let on_tip = root(1.0, from.dot(&ray), from.norm_squared() - radius * radius).map(|t| (t, (from + ray * t) / radius));
    match (on_shaft, on_tip) {
        (Some(a), Some(b)) => Some(if a.0 < b.0 { a } else { b }),
        (a, b) => a.or(b),
    }
}

/// Smallest positive root of a t² + 2 b t + c.
fn root(a: f64, b: f64, c: f64) -> Option<f64> {
    let discriminant = b * b - a * c;
    if discriminant < 0.0 || a < 1e-12 {
        return None;
    }
    let t = (-b - discriminant.sqrt()) / a;
    (t > 0.0).then_some(t)
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;

    fn tool() -> ToolState {
        let mut tool = ToolState::zeroed();
        (tool.tip_mm, tool.direction, tool.radius_mm) = ([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 5.0);
        tool
    }

    fn camera() -> Camera {
        Camera { eye: [0.0, -100.0, 0.0], target: [0.0; 3], up: [0.0, 0.0, 1.0], fov_deg: 30.0 }
    }

    #[test]
    fn the_silhouette_is_a_half_disc_on_a_bar() {
        let mut picture = Picture::with_depth(400, 400);
        draw_tool(&mut picture, &camera(), &tool());
        let lit = |x: f64, z: f64| {
            let scale = 400.0 / (2.0 * 100.0 * 15f64.to_radians().tan());
            let (px, py) = (200.0 + x * scale, 200.0 - z * scale);
            picture.pixel(px as usize, py as usize) != [0; 3]
        };
        // tip up (the tool points to +z), shaft down
        assert!(lit(0.0, 4.5) && lit(0.0, -20.0) && lit(4.5, -10.0) && lit(-4.5, -10.0));
        assert!(!lit(0.0, 6.0) && !lit(6.0, -10.0) && !lit(4.5, 4.5));
        let depth = picture.depth.as_ref().unwrap()[200 * 400 + 200];
        assert!((depth - 95.0).abs() < 0.1, "{depth}");
    }

    #[test]
    fn tissue_in_front_hides_it_and_nonsense_draws_nothing() {
        let mut picture = Picture::with_depth(64, 64);
        picture.depth.as_mut().unwrap().fill(50.0);
        draw_tool(&mut picture, &camera(), &tool());
        assert!(picture.rgb.iter().all(|&v| v == 0));
        let mut picture = Picture::with_depth(64, 64);
        draw_tool(&mut picture, &camera(), &ToolState { direction: [0.0; 3], ..tool() });
        draw_tool(&mut picture, &camera(), &ToolState { tip_mm: [f64::NAN; 3], ..tool() });
        assert!(picture.rgb.iter().all(|&v| v == 0));
    }
}
