//! All integration tests, in one binary.

#[cfg(test)]
mod accuracy;
#[cfg(test)]
mod pictures;
#[cfg(test)]
mod references;
