//! Empty: the integration tests are the binary `wall`.
