//! The reader against files written by hand.
