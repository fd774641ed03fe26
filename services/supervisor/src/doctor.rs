//! What this machine has and lacks for maille: facts and one piece of advice each.

use crate::{enter, memory};
use maille_realtime::enter_realtime;
use maille_transport::Domain;
use rustix::{
    fs::{StatVfsMountFlags, statvfs},
    process::{Resource, getrlimit},
};
use std::fs;

/// How a finding should be taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// as it should be
    Good,
    /// maille runs, less well
    Advice,
    /// maille cannot run
    Fatal,
}

/// One fact, and what to do about it.
#[derive(Clone, Debug)]
pub struct Finding {
    /// what was looked at
    pub subject: &'static str,
    /// how it should be taken
    pub verdict: Verdict,
    /// what was found
    pub found: String,
    /// what to do; empty when nothing is to be done
    pub advice: String,
}

fn finding(subject: &'static str, verdict: Verdict, found: impl Into<String>, advice: impl Into<String>) -> Finding {
    Finding { subject, verdict, found: found.into(), advice: advice.into() }
}

/// A default run with its segments, with some room [bytes].
const COMFORTABLE: u64 = 1 << 30;

/// Looks at the machine. Changes nothing; a thread of its own asks for real-time priority and ends.
pub fn examine() -> Vec<Finding> {
    let mut findings = vec![cores(), vector_units()];
    findings.extend(shared_memory());
    findings.extend(real_time());
    findings.push(locked_memory());
    findings.push(processes());
    findings.push(runs());
    findings.push(finding(
        "GPU",
        Verdict::Good,
        "asked for by scenes with `rendering.backend = \"gpu\"` alone: without one, or without a driver for Vulkan, the CPU draws the same",
        "",
    ));
    findings.push(finding("page", Verdict::Good, "any browser on this machine shows it; none is needed to run (--headless)", ""));
    findings
}

fn cores() -> Finding {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let model = fs::read_to_string("/proc/cpuinfo").ok().and_then(|text| {
        let line = text.lines().find(|line| line.starts_with("model name"))?;
        Some(line.split_once(':')?.1.trim().to_owned())
    });
    let found = format!("{cores} of {}", model.unwrap_or_else(|| std::env::consts::ARCH.into()));
    if cores >= 2 {
        finding("cores", Verdict::Good, found, "")
    } else {
        finding("cores", Verdict::Advice, found, "with one core, pictures come when touch leaves time for them")
    }
}

fn vector_units() -> Finding {
    #[cfg(target_arch = "x86_64")]
    {
        let has = [
            ("AVX2", is_x86_feature_detected!("avx2")),
            ("FMA", is_x86_feature_detected!("fma")),
            ("AVX-512", is_x86_feature_detected!("avx512f")),
        ];
        let list: Vec<&str> = has.iter().filter(|(_, has)| *has).map(|(name, _)| *name).collect();
        if has[0].1 {
            finding("vector units", Verdict::Good, list.join(", "), "")
        } else {
            finding("vector units", Verdict::Advice, "no AVX2", "the ray caster takes its slower path")
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    finding("vector units", Verdict::Good, std::env::consts::ARCH, "")
}

fn shared_memory() -> Vec<Finding> {
    let subject = memory::SHARED_MEMORY;
    let (size, free) = match memory::shared_memory_space() {
        Ok(space) => space,
        Err(error) => {
            return vec![finding(
                subject,
                Verdict::Fatal,
                format!("not there ({error})"),
                "mount a tmpfs: `sudo mount -t tmpfs tmpfs /dev/shm`",
            )];
        }
    };
    let found = format!("{} MiB, {} MiB free", size >> 20, free >> 20);
    let enlarge = "`sudo mount -o remount,size=2G /dev/shm`, in a container `--shm-size=2g`";
    let mut findings = vec![match free {
        0..0x800_0000 => finding(subject, Verdict::Fatal, found, format!("too little for any volume; {enlarge}")),
        0x800_0000..COMFORTABLE => finding(subject, Verdict::Advice, found, format!("enough for small volumes only; {enlarge}")),
        _ => finding(subject, Verdict::Good, found, ""),
    }];
    if statvfs(subject).is_ok_and(|stat| stat.f_flag.contains(StatVfsMountFlags::RDONLY)) {
        findings.push(finding(subject, Verdict::Fatal, "mounted read-only", "`sudo mount -o remount,rw /dev/shm`"));
    }
    match Domain::fresh().map(|domain| domain.remove()) {
        Ok(_) => {}
        Err(error) => findings.push(finding(
            subject,
            Verdict::Fatal,
            format!("cannot be written: {error}"),
            "check its mode: `sudo chmod 1777 /dev/shm`",
        )),
    }
    findings
}

fn real_time() -> Vec<Finding> {
    // asked on a thread that ends: nothing else of this process becomes real-time
    let notices = std::thread::spawn(|| enter_realtime(1, None)).join().unwrap_or_default();
    let limit = limit(Resource::Rtprio);
    if notices.is_empty() {
        return vec![finding("SCHED_FIFO", Verdict::Good, format!("granted (RLIMIT_RTPRIO {limit})"), "")];
    }
    let advice = "`ulimit -r 80`, or `@realtime - rtprio 80` in /etc/security/limits.conf and log in again; until then the 1 kHz loop is less punctual under load";
    let told = notices.iter().map(|n| n.0.split(';').next().unwrap_or_default().to_owned());
    told.map(|told| finding("SCHED_FIFO", Verdict::Advice, format!("{told} (RLIMIT_RTPRIO {limit})"), advice)).collect()
}

fn limit(resource: Resource) -> String {
    match getrlimit(resource).current {
        Some(value) => value.to_string(),
        None => "unlimited".into(),
    }
}

fn locked_memory() -> Finding {
    let subject = "locked memory";
    match getrlimit(Resource::Memlock).current {
        None => finding(subject, Verdict::Good, "unlimited", ""),
        Some(bytes) if rustix::process::geteuid().is_root() => {
            finding(subject, Verdict::Good, format!("RLIMIT_MEMLOCK {} KiB, which does not bind root", bytes >> 10), "")
        }
        Some(bytes) if bytes >= 256 << 20 => finding(subject, Verdict::Good, format!("{} MiB", bytes >> 20), ""),
        Some(bytes) => {
            let advice = "`ulimit -l unlimited`, or a memlock line in /etc/security/limits.conf; until then a page fault may delay a tick";
            finding(subject, Verdict::Advice, format!("RLIMIT_MEMLOCK {} KiB", bytes >> 10), advice)
        }
    }
}

fn processes() -> Finding {
    let me = rustix::process::getpid();
    match rustix::process::pidfd_open(me, rustix::process::PidfdFlags::empty()) {
        Ok(_) => finding("process watch", Verdict::Good, "pidfd", ""),
        Err(error) => finding(
            "process watch",
            Verdict::Fatal,
            format!("no pidfd ({error})"),
            "Linux 5.3 or later is needed, and a sandbox that allows pidfd_open",
        ),
    }
}

fn runs() -> Finding {
    let living: Vec<String> = enter::living_runs().into_iter().map(|(name, services)| format!("{name} ({services} services)")).collect();
    let dead = Domain::list().iter().filter(|domain| !domain.is_alive()).count();
    let running = if living.is_empty() { "none running".to_owned() } else { format!("running: {}", living.join(", ")) };
    if dead == 0 {
        finding("runs", Verdict::Good, running, "")
    } else {
        finding(
            "runs",
            Verdict::Advice,
            format!("{running}; {dead} dead left memory behind"),
            "`maille clean` removes it; so does the next `maille run`",
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn everything_that_is_not_good_says_what_to_do() {
        let findings = examine();
        assert!(findings.len() >= 8);
        for f in findings {
            assert_eq!(f.verdict == Verdict::Good, f.advice.is_empty(), "{f:?}");
        }
    }
}
