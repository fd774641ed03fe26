//! Names: roles of processes, topics, segments.

/// A process of the simulation; its number is its place in [`ControlBlock::services`](crate::ControlBlock::services).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u32)]
pub enum Role {
    /// 1 kHz loop: device, contact, force
    Haptic = 0,
    /// ChainMail and the mapper; the store's writer
    Deformation = 1,
    /// ray caster; publishes frames
    Rendering = 2,
    /// web page
    Console = 3,
}

impl Role {
    /// All roles, in order of their numbers.
    pub const ALL: [Self; 4] = [Self::Haptic, Self::Deformation, Self::Rendering, Self::Console];

    /// Word used on the command line and in reports.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Haptic => "haptic",
            Self::Deformation => "deformation",
            Self::Rendering => "rendering",
            Self::Console => "console",
        }
    }

    /// Name shown by `ps` (at most 15 characters, the kernel's limit for a thread's name).
    pub const fn process_name(self) -> &'static str {
        match self {
            Self::Haptic => "maille-haptic",
            Self::Deformation => "maille-deform",
            Self::Rendering => "maille-render",
            Self::Console => "maille-console",
        }
    }

    /// `argv[0]` of the process.
    pub const fn argv0(self) -> &'static str {
        match self {
            Self::Haptic => "maille-haptic",
            Self::Deformation => "maille-deformation",
            Self::Rendering => "maille-rendering",
            Self::Console => "maille-console",
        }
    }

    /// The role that a word names.
    pub fn from_word(word: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|r| r.word() == word)
    }

    /// Pins of the store that belong to the role: a restarted process takes over those of its predecessor, and the
    /// supervisor releases them when the process has died.
    pub const fn pins(self) -> core::ops::Range<usize> {
        let first = self as usize * PINS_PER_ROLE;
        first..first + PINS_PER_ROLE
    }
}

/// Pins a role owns.
pub const PINS_PER_ROLE: usize = 4;

/// Topics of iceoryx2's publish-subscribe, inside a domain.
pub mod topic {
    /// [`ToolState`](crate::ToolState), haptic → rendering, console
    pub const TOOL_STATE: &str = "maille/tool-state/v2";
    /// [`ToolMove`](crate::ToolMove), haptic → deformation
    pub const TOOL_MOVE: &str = "maille/tool-move/v1";
    /// [`Commit`](crate::Commit), deformation → rendering, haptic, console
    pub const COMMIT: &str = "maille/commit/v1";
    /// [`ViewState`](crate::ViewState), console → all
    pub const VIEW_STATE: &str = "maille/view-state/v1";
    /// [`ToolCommand`](crate::ToolCommand), console → haptic
    pub const TOOL_COMMAND: &str = "maille/tool-command/v1";
    /// pixels with [`FrameHeader`](crate::FrameHeader) as user header, rendering → console
    pub const FRAME: &str = "maille/frame/v2";
    /// [`Ping`](crate::probe::Ping), only in a domain of `maille latency`
    pub const PING: &str = "maille/ping/v1";
    /// [`Pong`](crate::probe::Pong), only in a domain of `maille latency`
    pub const PONG: &str = "maille/pong/v1";
}

/// Events that wake a listener, inside a domain.
pub mod event {
    /// wakes the peer of who measures, only in a domain of `maille latency`
    pub const ASKED: &str = "maille/asked/v1";
    /// wakes who measures, only in a domain of `maille latency`
    pub const ANSWERED: &str = "maille/answered/v1";
}

/// Segments of a domain; the name in /dev/shm is the domain's, an underscore, and this.
pub mod segment {
    /// [`ControlBlock`](crate::ControlBlock); all map it read-write
    pub const CONTROL: &str = "control";
    /// [`index`](crate::index); written by the store's writer, read by all
    pub const INDEX: &str = "index";
    /// rest bricks; written once by the supervisor
    pub const REST: &str = "rest";
    /// brick versions; written by the store's writer
    pub const VERSIONS: &str = "versions";
    /// displacement versions; written by the store's writer
    pub const DISPLACEMENT: &str = "displacement";
    /// versions of the deformation's small state
    pub const STATE: &str = "state";
    /// versions of the plastic part of displacements; written by the store's writer
    pub const PLASTIC: &str = "plastic";
    /// versions of cut links; written by the store's writer
    pub const CUTS: &str = "cuts";
    /// versions of labels; written by the store's writer
    pub const LABELS: &str = "labels";
    /// versions of the octree's leaves of rewritten bricks; written by the store's writer
    pub const OCTREE: &str = "octree";
    /// read-only regions, followed by the region's name; written once by the supervisor
    pub const REGION: &str = "region-";
}
