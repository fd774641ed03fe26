//! Tissues and their CT numbers.
//!
//! HU are those of an adult CT at 120 kV with contrast in the vessels, rounded: [ICRU 44; Schneider, Pedroni & Lomax 1996].

/// A tissue.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[repr(u8)]
#[allow(missing_docs)] // the names are the tissues
pub enum Label {
    Air = 0,
    Skin,
    Fat,
    Muscle,
    Mucosa,
    Cartilage,
    Bone,
    SpongyBone,
    Tooth,
    Fluid,
    GrayMatter,
    WhiteMatter,
    Vitreous,
    Lens,
    Nerve,
    Vessel,
    Gland,
    Lung,
    Diaphragm,
    Heart,
    Liver,
    LiverVessel,
    BileDuct,
    Lesion,
    Spleen,
    Kidney,
    Bowel,
    Disc,
}

/// (name, HU, smooth texture's amplitude, noise's amplitude), in the order of the labels.
const TABLE: [(&str, f64, f64, f64); 28] = [
    ("air", -1000.0, 0.0, 12.0),
    ("skin", 70.0, 10.0, 18.0),
    ("fat", -100.0, 14.0, 16.0),
    ("muscle", 55.0, 16.0, 18.0),
    ("mucosa", 45.0, 12.0, 18.0),
    ("cartilage", 120.0, 20.0, 18.0),
    ("bone", 1150.0, 130.0, 40.0),
    ("spongy bone", 380.0, 150.0, 40.0),
    ("tooth", 2100.0, 120.0, 40.0),
    ("fluid", 8.0, 3.0, 16.0),
    ("gray matter", 40.0, 3.0, 14.0),
    ("white matter", 28.0, 3.0, 14.0),
    ("vitreous", 6.0, 2.0, 14.0),
    ("lens", 80.0, 2.0, 14.0),
    ("nerve", 35.0, 3.0, 14.0),
    ("vessel", 260.0, 10.0, 18.0),
    ("gland", 25.0, 18.0, 18.0),
    ("lung", -830.0, 45.0, 25.0),
    ("diaphragm", 52.0, 8.0, 18.0),
    ("heart", 130.0, 10.0, 18.0),
    ("liver", 105.0, 10.0, 18.0),
    ("liver vessel", 175.0, 8.0, 18.0),
    ("bile duct", 6.0, 3.0, 16.0),
    ("lesion", 55.0, 16.0, 18.0),
    ("spleen", 118.0, 8.0, 18.0),
    ("kidney", 170.0, 22.0, 18.0),
    ("bowel", 32.0, 24.0, 18.0),
    ("disc", 85.0, 8.0, 18.0),
];

impl Label {
    /// All labels, by number.
    pub const ALL: [Self; 28] = [
        Self::Air,
        Self::Skin,
        Self::Fat,
        Self::Muscle,
        Self::Mucosa,
        Self::Cartilage,
        Self::Bone,
        Self::SpongyBone,
        Self::Tooth,
        Self::Fluid,
        Self::GrayMatter,
        Self::WhiteMatter,
        Self::Vitreous,
        Self::Lens,
        Self::Nerve,
        Self::Vessel,
        Self::Gland,
        Self::Lung,
        Self::Diaphragm,
        Self::Heart,
        Self::Liver,
        Self::LiverVessel,
        Self::BileDuct,
        Self::Lesion,
        Self::Spleen,
        Self::Kidney,
        Self::Bowel,
        Self::Disc,
    ];

    /// The number voxels of a label volume hold.
    pub fn number(self) -> u8 {
        self as u8
    }

    /// The label of a number.
    pub fn from_number(number: u8) -> Option<Self> {
        Self::ALL.get(usize::from(number)).copied()
    }

    /// The tissue's name.
    pub fn name(self) -> &'static str {
        TABLE[self as usize].0
    }

    /// Mean CT number [HU].
    pub fn hu(self) -> f64 {
        TABLE[self as usize].1
    }

    /// Largest deviation from [`Self::hu`] [HU]: of the texture fixed in space, and of the noise.
    pub fn texture(self) -> [f64; 2] {
        let (_, _, smooth, noise) = TABLE[self as usize];
        [smooth, noise]
    }

    /// Whether the tissue is bone or tooth, which no tool dents.
    pub fn is_rigid(self) -> bool {
        matches!(self, Self::Bone | Self::SpongyBone | Self::Tooth)
    }
}
