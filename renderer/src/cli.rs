//! The command line of the `renderer` program; the wall runs the same for its local render servers.
