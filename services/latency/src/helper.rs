//! A helper process: this program once more, told what to do on its standard input, heard on its standard output.

use crate::{LatencyError, io};
use rustix::process::{Signal, getppid, set_parent_process_death_signal};
use std::{
    io::{BufRead as _, BufReader, Write as _},
    os::unix::process::CommandExt as _,
    path::Path,
    process::{Child, ChildStdin, ChildStdout, Command, Stdio},
};

/// Name of helpers in `ps`.
const ARGV0: &str = "maille-latency";
/// Subcommand of helpers.
pub(crate) const SUBCOMMAND: &str = "latency-helper";

/// A child that ends with this value, and by the kernel's hand with this process.
pub(crate) struct Helper {
    child: Child,
    input: Option<ChildStdin>,
    output: BufReader<ChildStdout>,
}

/// Binds the calling process's life to its parent's; call it first, on the main thread.
///
/// # Errors
/// When the parent is gone already.
pub fn end_with(parent: u32) -> Result<(), LatencyError> {
    // asked for first and checked second, or a parent that dies in between would be missed
    set_parent_process_death_signal(Some(Signal::KILL)).map_err(|e| io("the end of the parent cannot be followed")(e.into()))?;
    let same = getppid().is_some_and(|id| id.as_raw_nonzero().get().unsigned_abs() == parent);
    if same { Ok(()) } else { Err(LatencyError::Helper("was started by nobody: it is part of `maille latency`".into())) }
}

impl Helper {
    /// Starts one for a domain; `more` are further arguments.
    pub fn start(program: &Path, what: &str, domain: &str, more: &[String]) -> Result<Self, LatencyError> {
        let mut child = Command::new(program)
            .arg0(ARGV0)
            .args([SUBCOMMAND, what, "--domain", domain, "--parent"])
            .arg(std::process::id().to_string())
            .args(more)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            // Ctrl-C reaches this process alone, which then ends the helper
            .process_group(0)
            .spawn()
            .map_err(io(format!("{} cannot be started", program.display())))?;
        let (input, output) = (child.stdin.take(), child.stdout.take().expect("it was asked for"));
        Ok(Self { child, input, output: BufReader::new(output) })
    }

    /// Sends it a line.
    pub fn tell(&mut self, line: &str) -> Result<(), LatencyError> {
        let input = self.input.as_mut().expect("it is open while the helper lives");
        writeln!(input, "{line}").map_err(io("the helper process cannot be told what to do"))
    }

    /// Waits for its next line; `None` at its end. Helpers bound their own time.
    pub fn hear(&mut self) -> Result<Option<String>, LatencyError> {
        let mut line = String::new();
        let bytes = self.output.read_line(&mut line).map_err(io("the helper process cannot be heard"))?;
        Ok((bytes > 0).then(|| line.trim_end().to_owned()))
    }

    /// Waits for a line that begins with a word, and returns what follows.
    pub fn expect(&mut self, word: &str) -> Result<String, LatencyError> {
        match self.hear()? {
            Some(line) if line.split(' ').next() == Some(word) => Ok(line[word.len()..].trim().to_owned()),
            Some(line) => Err(LatencyError::Helper(format!("said {line:?} where {word:?} was awaited"))),
            None => Err(LatencyError::Helper("ended before it was told to".into())),
        }
    }
}

impl Drop for Helper {
    fn drop(&mut self) {
        drop(self.input.take());
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
