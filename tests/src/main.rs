//! All integration tests, in one binary.

#[cfg(test)]
mod accuracy;
#[cfg(test)]
mod bad_input;
#[cfg(test)]
mod bench;
#[cfg(test)]
mod churn;
#[cfg(test)]
mod farm;
#[cfg(test)]
mod liars;
#[cfg(test)]
mod measuring;
#[cfg(test)]
mod pictures;
#[cfg(test)]
mod ply_suite;
#[cfg(test)]
mod process;
#[cfg(test)]
mod readme;
#[cfg(test)]
mod references;
#[cfg(test)]
mod trust;
#[cfg(all(test, target_os = "linux"))]
mod window;
#[cfg(all(test, target_os = "linux"))]
mod x_drop;
#[cfg(all(test, target_os = "linux"))]
mod x_session;
