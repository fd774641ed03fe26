//! From the scene's `[device]` to a real device.

use crate::HapticError;
use maille_device::{Kind, Mounting, Options, RemoteDevice, profiles};
use maille_scene::{Device, RealDevice, Scene, Tool, Waypoints};
use std::io::Write as _;

/// The real device that a tool asks for.
pub(crate) fn kind(tool: &Tool) -> Option<Kind> {
    match tool.device {
        Device::Real(RealDevice::Inverse3) => Some(Kind::Inverse3),
        Device::Real(RealDevice::Touch) => Some(Kind::Touch),
        Device::Real(RealDevice::ForceDimension) => Some(Kind::ForceDimension),
        _ => None,
    }
}

/// How to find and use it; a kind that is none is a device in another process, which stands as its owner says.
#[allow(clippy::disallowed_macros)] // before the first tick
pub(crate) fn options(scene: &Scene, kind: Option<Kind>) -> Result<Options, HapticError> {
    let d = &scene.device;
    let named = |name: &String| {
        let known = || profiles::ALL.map(|p| p.name).join(", ");
        profiles::named(name).ok_or_else(|| HapticError::Scene(format!("there is no device profile `{name}`; there are {}", known())))
    };
    let usual = Options::default();
    let origin_mm = d.origin_mm.unwrap_or_default();
    let front = kind.map_or(Mounting { origin_mm, ..Mounting::default() }, |kind| Mounting::in_front_of_patient(kind, origin_mm));
    let priority = scene.haptic.priority.min(99) as i32;
    Ok(Options {
        address: d.address.clone().unwrap_or(usual.address),
        library: d.library.clone(),
        device: d.id.clone(),
        mounting: Mounting { rotation: d.rotation.unwrap_or(front.rotation), scale: d.scale.unwrap_or(1.0), ..front },
        // below the tick, above all else; of the lowest there is none below
        priority: if priority > 1 { priority - 1 } else { priority },
        profile: d.profile.as_ref().map(named).transpose()?,
        ..usual
    })
}

/// Opens it, its origin at the first way point where the scene says no other. A device that is not plugged in is waited for.
pub(crate) fn open(kind: Kind, mut options: Options, scene: &Scene, way: &Waypoints) -> Result<RemoteDevice, HapticError> {
    if scene.device.origin_mm.is_none() {
        options.mounting.origin_mm = way.at(0.0).position_mm;
    }
    // a terminal that has gone is no reason to panic
    let tell = |sentence: &str| drop(writeln!(std::io::stderr(), "maille-haptic: {sentence}"));
    Ok(maille_device::open_telling(kind, &options, tell)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Without a rotation in the scene each device stands as its maker's axes say: a hand that goes down goes into a patient on the back.
    #[test]
    fn a_scene_that_says_nothing_of_axes_has_each_device_upright() {
        let scene = Scene::builtin_default();
        for (kind, down) in [(Kind::Touch, [0.0, -5.0, 0.0]), (Kind::ForceDimension, [0.0, 0.0, -5.0]), (Kind::Inverse3, [0.0, 0.0, -5.0])]
        {
            let mounting = options(&scene, Some(kind)).unwrap().mounting;
            assert_eq!(mounting.place(down).map(|c| c + 0.0), [0.0, 5.0, 0.0], "{kind:?}");
        }
    }

    #[test]
    fn what_scenes_call_devices_is_what_devices_are_called() {
        for (device, name) in RealDevice::ALL {
            let tool = Tool { device: Device::Real(device), ..Tool::default() };
            assert_eq!(kind(&tool).map(Kind::name), Some(name));
        }
        assert_eq!(maille_scene::PROFILES, profiles::ALL.map(|p| p.name));
        let mut scene = Scene::builtin_default();
        scene.device.profile = Some("touch".into());
        assert_eq!(options(&scene, None).unwrap().profile, Some(profiles::TOUCH));
        scene.device.profile = Some("feather".into());
        assert!(options(&scene, None).is_err());
    }
}
