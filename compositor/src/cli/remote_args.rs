//! The options of the remote.

use std::path::PathBuf;

use crate::{
    remote::RemoteOptions,
    window::{host_name, own_address},
};

/// Where the remote is served, and to whom.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct RemoteArgs {
    /// Serve a page that steers the wall, and the same as an API, on this address: 0.0.0.0:7180 for phones in the network.
    /// Without --remote-tokens, only 127.0.0.1 is possible
    #[arg(long, help_heading = "Remote", value_name = "HOST:PORT", conflicts_with = "headless")]
    pub remote: Option<String>,
    /// The file of tokens that let people in; `compositor remote-token` makes it
    #[arg(long, help_heading = "Remote", value_name = "FILE", requires = "remote")]
    pub remote_tokens: Option<PathBuf>,
    /// Encrypt the remote (HTTPS) by the certificate in this file, a chain and its private key as PEM; without such a file, the
    /// wall makes one, of which browsers warn
    #[arg(long, help_heading = "Remote", value_name = "FILE", requires = "remote")]
    pub remote_certificate: Option<PathBuf>,
    /// Another name under which the remote is reached, as through a proxy that encrypts
    #[arg(long, help_heading = "Remote", value_name = "NAME", requires = "remote")]
    pub remote_name: Option<String>,
}

impl RemoteArgs {
    pub(crate) fn options(&self) -> Option<RemoteOptions> {
        Some(RemoteOptions {
            address: self.remote.clone()?,
            tokens: self.remote_tokens.clone(),
            certificate: self.remote_certificate.clone(),
            name: self.remote_name.clone(),
            host_name: host_name(),
            own_address: own_address(),
        })
    }
}
