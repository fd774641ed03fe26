//! One process of the run: started, watched by pidfd, its last lines kept, ended.
//!
//! A service is this same program, executed again with `argv[0]` and a subcommand of its own (DESIGN D13), in a process
//! group of its own so that Ctrl-C on the terminal reaches the supervisor alone. What it writes to its outputs comes
//! through a pipe: each line goes on to standard error behind the role's name, and the last ones are kept as evidence.
//! A service started by hand has a pidfd too, but no pipe and no exit status.
//!
//! Invariant: nothing here waits. The pipe does not block, the death is learnt from the pidfd.

use maille_contract::Role;
use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    fs::{OFlags, fcntl_setfl},
    io::Errno,
    process::{Pid, PidfdFlags, Signal, pidfd_open, pidfd_send_signal},
};
use std::{
    collections::VecDeque,
    io::{self, PipeReader, Read as _},
    os::{
        fd::{AsFd, BorrowedFd, OwnedFd},
        unix::process::{CommandExt as _, ExitStatusExt as _},
    },
    process::{Child, Command, Stdio},
};

/// Lines kept of what a service said last.
const TAIL_LINES: usize = 12;
/// A line longer than this is cut, so that a service that writes no line ends does not fill memory [bytes].
const LINE_BYTES: usize = 4096;

/// A living (or just dead) process that plays a role.
pub struct Process {
    /// what it plays
    pub role: Role,
    /// its id
    pub pid: u32,
    pidfd: OwnedFd,
    child: Option<Child>,
    output: Option<PipeReader>,
    line: Vec<u8>,
    tail: VecDeque<String>,
}

impl Process {
    /// Starts a service as a child. Call on the main thread: the kernel takes the death of the thread that started a child
    /// for the death of its parent.
    pub fn start(role: Role, domain: &str) -> io::Result<Self> {
        let (reader, writer) = io::pipe()?;
        fcntl_setfl(&reader, OFlags::NONBLOCK)?;
        // The link of the running image, not its path: a restart gets the same build even when the file was replaced.
        let child = Command::new("/proc/self/exe")
            .arg0(role.argv0())
            .args(["service", role.word(), "--domain", domain, "--parent"])
            .arg(std::process::id().to_string())
            .stdin(Stdio::null())
            .stdout(writer.try_clone()?)
            .stderr(writer)
            .process_group(0)
            .spawn()?;
        let pid = child.id();
        // The child is not reaped yet, so its id cannot have been given to another process.
        let pidfd = pidfd_open(Pid::from_child(&child), PidfdFlags::NONBLOCK)?;
        Ok(Self { role, pid, pidfd, child: Some(child), output: Some(reader), line: Vec::new(), tail: VecDeque::new() })
    }

    /// Watches a process that somebody else started; `None` when it is already gone.
    pub fn adopt(role: Role, pid: u32) -> io::Result<Option<Self>> {
        let Some(id) = i32::try_from(pid).ok().and_then(Pid::from_raw) else { return Ok(None) };
        match pidfd_open(id, PidfdFlags::NONBLOCK) {
            Ok(pidfd) => Ok(Some(Self { role, pid, pidfd, child: None, output: None, line: Vec::new(), tail: VecDeque::new() })),
            Err(Errno::SRCH) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// Whether it was started by hand.
    pub fn by_hand(&self) -> bool {
        self.child.is_none()
    }

    /// Becomes readable when the process has ended.
    pub fn pidfd(&self) -> BorrowedFd<'_> {
        self.pidfd.as_fd()
    }

    /// Becomes readable when the process has said something.
    pub fn output(&self) -> Option<BorrowedFd<'_>> {
        self.output.as_ref().map(AsFd::as_fd)
    }

    /// Passes on what the process has said so far.
    pub fn drain(&mut self) {
        let Some(output) = &mut self.output else { return };
        let mut bytes = [0; 4096];
        // Bounded, so that a service that writes without end cannot hold the loop.
        for _ in 0..16 {
            match output.read(&mut bytes) {
                Ok(0) => {
                    self.output = None;
                    break;
                }
                Ok(n) => {
                    for &byte in &bytes[..n] {
                        if byte == b'\n' || self.line.len() >= LINE_BYTES {
                            let line = String::from_utf8_lossy(&std::mem::take(&mut self.line)).into_owned();
                            crate::output::error_line(format_args!("{}: {line}", self.role.word()));
                            self.tail.push_back(line);
                            if self.tail.len() > TAIL_LINES {
                                self.tail.pop_front();
                            }
                        }
                        if byte != b'\n' {
                            self.line.push(byte);
                        }
                    }
                }
                Err(_) => break,
            }
        }
    }

    /// How the process ended, in words, once the kernel says that it has; the exit status is taken with it. Never waits.
    pub fn dead(&mut self) -> Option<String> {
        let Some(child) = &mut self.child else {
            let now = Timespec { tv_sec: 0, tv_nsec: 0 };
            let ended = poll(&mut [PollFd::new(&self.pidfd, PollFlags::IN)], Some(&now)).is_ok_and(|ready| ready > 0);
            return ended.then(|| "ended".into());
        };
        match child.try_wait() {
            Ok(None) => None,
            Ok(Some(status)) => Some(match (status.code(), status.signal()) {
                (Some(code), _) => format!("exit status {code}"),
                (None, Some(signal)) => format!("killed by signal {signal}"),
                (None, None) => status.to_string(),
            }),
            Err(error) => Some(format!("its end cannot be learnt ({error})")),
        }
    }

    /// Ends it with a signal that cannot be refused. No other process can be hit: the pidfd stands for this one.
    pub fn kill(&self) {
        let _ = pidfd_send_signal(&self.pidfd, Signal::KILL);
    }

    /// The last lines that it said.
    pub fn tail(&self) -> impl Iterator<Item = &str> {
        self.tail.iter().map(String::as_str)
    }
}
