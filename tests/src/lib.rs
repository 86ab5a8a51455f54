//! The harness of the tests: real programs, real sockets, a real window.
