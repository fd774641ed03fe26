//! The same code for the processor at hand.
//!
//! Everything is compiled twice: for the instructions that every processor of its kind has, and for AVX2 where it is found at run
//! time. Rust never contracts a·b + c into one rounding, so that both give the same bits.
#![allow(unsafe_code)]

/// Work whose body is to be inlined (`#[inline(always)]`) into the function that has the instructions.
pub(crate) trait Task {
    /// What it gives.
    type Output;
    /// Does it.
    fn run(self) -> Self::Output;
}

/// Does a task with the widest vectors that this processor has.
#[inline]
pub(crate) fn widest<T: Task>(task: T) -> T::Output {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("bmi1") && is_x86_feature_detected!("bmi2") {
        // SAFETY: the line above found the instructions on this processor.
        return unsafe { with_avx2(task) };
    }
    task.run()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,bmi1,bmi2")]
fn with_avx2<T: Task>(task: T) -> T::Output {
    task.run()
}
