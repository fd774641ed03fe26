//! Placeholder: replaced by the part's first commit.
