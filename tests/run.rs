//! `maille run` as a person has it: the real program, the real services, a small made head.
//!
//! What is asked here: the report has every key that other tools read, each kind of end leaves nothing behind, a killed service
//! comes back while the others keep their processes. How well the services do their work is their own tests' business;
//! supervision alone, with services that misbehave, is tested in `services/supervisor/tests/supervision.rs`.
//!
//! Each run has a domain of its own, so that runs of somebody else on the same machine are neither used nor disturbed.

#[path = "../services/supervisor/tests/support/mod.rs"]
mod support;

use maille_contract::Role;
use rustix::process::Signal;
use std::{
    io::{Read as _, Write as _},
    net::TcpStream,
    process::Command,
    time::{Duration, Instant},
};
use support::{Run, SMALL_SCENE, Scratch, eventually, left_over, lives, report, signal};

const SERVICES: [Role; 3] = [Role::Haptic, Role::Deformation, Role::Rendering];

fn maille() -> Command {
    Command::new(env!("CARGO_BIN_EXE_maille"))
}

fn start(scratch: &Scratch, arguments: &[&str]) -> Run {
    let scene = scratch.write("small.toml", SMALL_SCENE);
    Run::start(maille().arg("run").arg(scene).args(arguments))
}

#[test]
fn a_headless_run_ends_by_itself_with_a_full_report_and_leaves_nothing() {
    let scratch = Scratch::new("run-report");
    let path = scratch.file("run.json");
    let mut run = start(&scratch, &["--headless", "--duration", "6s", "--report", path.to_str().unwrap()]);
    let domain = run.domain();
    let pids = SERVICES.map(|role| run.service(role, 1));
    assert!(run.wait().success(), "{}", run.printed());
    assert_eq!(left_over(&domain), [""; 0]);
    assert!(pids.iter().all(|&pid| !lives(pid)));

    let report = report(&path);
    let number = |path: &str| {
        let value = report.pointer(path).unwrap_or_else(|| panic!("{path} is missing in {report:#}"));
        value.as_f64().unwrap_or_else(|| panic!("{path} is no number in {report:#}"))
    };
    for (role, pid) in SERVICES.into_iter().zip(pids) {
        let service = format!("/services/{}", role.word());
        assert_eq!(number(&format!("{service}/pid")), f64::from(pid));
        assert_eq!(number(&format!("{service}/restarts")), 0.0, "{}", run.printed());
        assert!(number(&format!("{service}/private_mib")) > 0.0);
    }
    for histogram in ["haptic/tick_us", "haptic/lateness_us", "deformation/step_us", "rendering/frame_ms"] {
        let [p50, p99, p999, max] = ["p50", "p99", "p999", "max"].map(|p| number(&format!("/services/{histogram}/{p}")));
        assert!(0.0 < max && p50 <= p99 && p99 <= p999 && p999 <= max, "{histogram}: {p50} {p99} {p999} {max}");
    }
    assert!(number("/services/haptic/rate_hz") > 0.0);
    assert!(number("/services/haptic/overruns") >= 0.0);
    assert!(number("/services/deformation/commits") > 0.0, "tissue has given way: {report:#}");
    assert!(number("/services/deformation/moved_elements") > 0.0);
    assert!(number("/services/rendering/frames") > 0.0);
    assert_eq!(number("/store/voxels_mib"), 2.0 * 64.0 * 64.0 * 64.0 / 1_048_576.0);
    assert!(number("/store/segment_mib") > number("/store/voxels_mib"));
    assert!(number("/store/spare_slots_low") > 0.0);
}

#[test]
fn the_page_is_there_while_the_run_is_and_signals_end_both() {
    let scratch = Scratch::new("run-signals");
    for sent in [Signal::INT, Signal::TERM] {
        // A machine that does much else may delay the end: within two seconds in one of three tries.
        let late: Vec<Duration> = (0..3)
            .map_while(|tried| {
                let mut run = start(&scratch, &[]);
                let domain = run.domain();
                let pids = Role::ALL.map(|role| run.service(role, 1));
                let port: u16 = run.nth(1, "the page", |line| line.split_once("http://127.0.0.1:")?.1.trim().parse().ok());
                let mut page = TcpStream::connect(("127.0.0.1", port)).unwrap();
                write!(page, "GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\n\r\n").unwrap();
                let mut answer = String::new();
                page.read_to_string(&mut answer).unwrap();
                assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");

                let began = Instant::now();
                signal(run.pid(), sent);
                assert!(run.wait().success(), "{}", run.printed());
                let time = began.elapsed();
                assert_eq!(left_over(&domain), [""; 0]);
                assert!(pids.iter().all(|&pid| !lives(pid)));
                (tried == 0 || time >= Duration::from_secs(2)).then_some(time)
            })
            .collect();
        assert!(late.len() < 3, "{sent:?} took {late:?}");
    }
}

#[test]
fn a_killed_service_comes_back_and_the_others_keep_their_processes() {
    let scratch = Scratch::new("run-kills");
    let path = scratch.file("run.json");
    let mut run = start(&scratch, &["--headless", "--report", path.to_str().unwrap()]);
    let domain = run.domain();
    let mut pids = SERVICES.map(|role| run.service(role, 1));
    for (n, role) in SERVICES.into_iter().enumerate() {
        std::thread::sleep(Duration::from_millis(2_000));
        signal(pids[n], Signal::KILL);
        let second = run.service(role, 2);
        assert_ne!(second, pids[n]);
        pids[n] = second;
        assert!(pids.iter().all(|&pid| lives(pid)), "{}", run.printed());
    }
    std::thread::sleep(Duration::from_millis(2_000));
    signal(run.pid(), Signal::TERM);
    assert!(run.wait().success());
    let report = report(&path);
    for (role, pid) in SERVICES.into_iter().zip(pids) {
        let service = &report["services"][role.word()];
        assert_eq!((service["pid"].as_u64(), service["restarts"].as_u64()), (Some(pid.into()), Some(1)), "{}", run.printed());
    }
    assert_eq!(left_over(&domain), [""; 0]);
}

#[test]
fn services_end_with_a_killed_supervisor_and_clean_removes_the_rest() {
    let scratch = Scratch::new("run-orphans");
    // Within a second; a machine that does much else may delay one of three tries.
    let mut domain = String::new();
    let times: Vec<Duration> = (0..3)
        .map_while(|tried| {
            let mut run = start(&scratch, &["--headless"]);
            let orphans = run.domain();
            assert!(domain.is_empty() || left_over(&domain).is_empty(), "a new run has not removed what the dead one left");
            let pids = SERVICES.map(|role| run.service(role, 1));
            std::thread::sleep(Duration::from_millis(1_500));
            signal(run.pid(), Signal::KILL);
            let time = eventually("the services are gone", || pids.iter().all(|&pid| !lives(pid)));
            run.wait();
            println!("supervisor killed: services gone after {:.0} ms", time.as_secs_f64() * 1e3);
            domain = orphans;
            (tried == 0 || time >= Duration::from_secs(1)).then_some(time)
        })
        .collect();
    assert!(times.len() < 3 || times.iter().any(|&time| time < Duration::from_secs(1)), "services outlived their supervisor by {times:?}");

    // a run that lives is left alone by `clean`
    let mut living = start(&scratch, &["--headless"]);
    let living_domain = living.domain();
    let pid = living.service(Role::Haptic, 1);
    let cleaned = maille().arg("clean").output().unwrap();
    assert!(cleaned.status.success(), "{cleaned:?}");
    let said = String::from_utf8_lossy(&cleaned.stdout);
    assert!(said.contains(&format!("{living_domain} is running")), "{said}");
    assert!(lives(pid));
    eventually("nothing is left", || left_over(&domain).is_empty());
    signal(living.pid(), Signal::TERM);
    assert!(living.wait().success());
    assert_eq!(left_over(&living_domain), [""; 0]);
}

#[test]
fn a_service_can_be_started_by_hand_where_the_run_leaves_room() {
    let scratch = Scratch::new("run-by-hand");
    let mut run = start(&scratch, &["--headless", "--by-hand", "rendering"]);
    let domain = run.domain();
    run.service(Role::Haptic, 1);
    let refused = maille().args(["service", "haptic", "--domain", &domain]).output().unwrap();
    assert_eq!(refused.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("--by-hand haptic"), "{refused:?}");
    let mut rendering = Run::start(maille().args(["service", "rendering", "--domain", &domain]));
    assert_eq!(run.service(Role::Rendering, 1), rendering.pid());
    signal(run.pid(), Signal::INT);
    assert!(run.wait().success());
    rendering.wait();
    assert_eq!(left_over(&domain), [""; 0]);
}

/// A device's library that is missing, no library, or another's; addresses and CPUs that are none: one sentence, before anything is made. A device that is
/// merely not plugged in is none of these (`tests/haptic.rs`).
#[test]
fn what_a_scene_names_and_this_machine_has_not_is_refused_before_the_run() {
    let scratch = Scratch::new("run-refused");
    let text = scratch.write("text.so", "no library at all").display().to_string();
    for (more, device, says) in [
        ("[device]\nlibrary = \"/nowhere/libHD.so\"\n".into(), "touch", "there is no library /nowhere/libHD.so"),
        (format!("[device]\nlibrary = \"{text}\"\n"), "touch", "text.so cannot be opened as a library"),
        (format!("[device]\nlibrary = \"{text}\"\n"), "forcedimension", "text.so cannot be opened as a library"),
        // a library that is there, and another one
        ("[device]\nlibrary = \"libc.so.6\"\n".into(), "touch", "libc.so.6 has no function hdInitDevice"),
        ("[device]\nlibrary = \"libc.so.6\"\n".into(), "forcedimension", "libc.so.6 has no function dhdGetDeviceCount"),
        ("[device]\nlibrary = \"libNone.so.9\"\n".into(), "touch", "libHD was not found"),
        ("[device]\nid = \"left\"\n".into(), "forcedimension", "`left` is no device of libdhd, which numbers them"),
        ("[device]\nid = \"-1\"\n".into(), "forcedimension", "`-1` is no device of libdhd"),
        ("[device]\naddress = \"nonsense\"\n".into(), "inverse3", "device.address is no address"),
        ("[haptic]\ncpu = 1023\n".into(), "path", "haptic.cpu = 1023 is none of the CPUs"),
    ] {
        let scene = SMALL_SCENE.replace("[tool]\n", &format!("[tool]\ndevice = \"{device}\"\n")) + &more;
        let scene = scratch.write("refused.toml", &scene);
        for command in [&["run", "--headless"][..], &["check", "--no-measure"]] {
            let output = maille().args(command).arg(&scene).output().unwrap();
            let [out, said] = [&output.stdout, &output.stderr].map(|bytes| String::from_utf8_lossy(bytes).into_owned());
            assert_eq!(output.status.code(), Some(1), "{command:?} {more}: {said}");
            // lines are broken where a terminal would end, also in the midst of a path
            let flat = |text: &str| text.replace(|c: char| c.is_whitespace() || c == '│', "");
            assert!(flat(&said).contains(&flat(says)), "{command:?} {more}: {said}");
            assert!(!out.contains("pid") && !out.contains("domain"), "nothing was started: {out}");
        }
    }
}

/// Opening a library runs what its maker wants; one that never comes back costs seconds, and its process is gone.
#[test]
fn a_device_s_library_that_hangs_where_it_is_opened_is_refused() {
    let scratch = Scratch::new("run-hanging");
    let source = "extern \"C\" fn hang() { loop { std::thread::sleep(std::time::Duration::from_secs(1)); } }\n\
                  #[used]\n#[unsafe(link_section = \".init_array\")]\nstatic HANG: extern \"C\" fn() = hang;\n";
    let (source, library) = (scratch.write("hang.rs", source), scratch.file("libhang.so"));
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let built = Command::new(rustc).args(["--edition", "2024", "--crate-type", "cdylib", "-o"]).arg(&library).arg(source).status();
    assert!(built.expect("rustc runs").success());
    let scene =
        SMALL_SCENE.replace("[tool]\n", "[tool]\ndevice = \"touch\"\n") + &format!("[device]\nlibrary = \"{}\"\n", library.display());
    let output = maille().args(["check", "--no-measure"]).arg(scratch.write("hanging.toml", &scene)).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{said}");
    // lines are broken where a terminal would end
    assert!(said.replace(|c: char| c.is_whitespace() || c == '│', "").contains("stillbeingopened"), "{said}");
    let processes = std::fs::read_dir("/proc").unwrap().flatten();
    let left = processes.filter(|p| std::fs::read_to_string(p.path().join("cmdline")).is_ok_and(|line| line.contains("libhang.so")));
    assert_eq!(left.count(), 0, "nothing is left of it");
}

/// What only a service can see, once it has the voxels: told once, as a refusal, instead of tried again and again.
#[test]
fn a_service_that_refuses_to_start_ends_the_run_with_its_sentence() {
    let scratch = Scratch::new("run-organ");
    let organ = "[[organ]]\nname = \"nowhere\"\nhu = [[1.0, 2.0]]\nseed = [0.0, 0.0, 0.0]\n";
    let output = maille().args(["run", "--headless"]).arg(scratch.write("organ.toml", &format!("{SMALL_SCENE}{organ}"))).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{said}");
    let last = said.lines().last().unwrap_or_default();
    assert!(last.starts_with("maille: the service rendering cannot start: the organ `nowhere`"), "{said}");
    let starts = String::from_utf8_lossy(&output.stdout).matches("rendering    pid").count();
    assert!((2..=4).contains(&starts), "two starts, two deaths: {}", String::from_utf8_lossy(&output.stdout));
}

#[test]
fn wrong_use_ends_with_2_and_what_is_refused_with_1_and_a_sentence() {
    let status = |arguments: &[&str]| {
        let output = maille().args(arguments).output().unwrap();
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    for wrong in [
        &["run", "--duration", "10"][..],
        &["run", "--device", "joystick"],
        &["run", "--by-hand", "touch"],
        &["service", "haptics", "--domain", "maille_00000000"],
        &["service", "haptic"],
    ] {
        assert_eq!(status(wrong).0, Some(2), "{wrong:?}");
    }
    for (refused, word) in [
        (&["run", "no-such-scene.toml"][..], "no-such-scene.toml"),
        (&["run", "--volume", "no-such-volume.nrrd"], "no-such-volume.nrrd"),
        (&["service", "haptic", "--domain", "maille_00000000"], "maille_00000000"),
        (&["service", "haptic", "--domain", "elsewhere"], "elsewhere"),
    ] {
        let (code, said) = status(refused);
        assert_eq!(code, Some(1), "{refused:?}: {said}");
        assert!(said.contains(word), "{said}");
    }
    let doctor = maille().arg("doctor").output().unwrap();
    assert!(doctor.status.success() && String::from_utf8_lossy(&doctor.stdout).contains("/dev/shm"), "{doctor:?}");
}
