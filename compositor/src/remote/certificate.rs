//! The certificate by which remotes know the wall, and that encrypts what they say; the wall makes one if it has none.

use std::{fmt::Write, io, net::IpAddr, path::Path, sync::Arc, time::SystemTime};

use anyhow::{Context, bail};
use channel::files;
use rcgen::{CertificateParams, DistinguishedName, DnType, KeyPair};
use sha2::{Digest, Sha256};
use tokio_rustls::{
    TlsAcceptor,
    rustls::{
        ServerConfig,
        crypto::ring,
        pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject},
    },
};

/// A chain of certificates and a key are shorter.
const LONGEST_FILE: u64 = 1 << 20;
/// The first line of files that the wall makes.
const OWN: &str = "# Made by a wall: nobody else vouches for it.";
/// Apple's devices trust no certificate for longer than 825 days.
const DAYS: u64 = 820;

/// A certificate, ready to accept connections.
pub(super) struct Certificate {
    pub(super) acceptor: TlsAcceptor,
    /// SHA-256 of the wall's own certificate, as browsers show it.
    pub(super) fingerprint: String,
    /// Whether a wall made it, so that browsers warn.
    pub(super) is_own: bool,
}

impl Certificate {
    /// Reads a file with a chain of certificates, the wall's own first, and its private key, all as PEM; without such a file,
    /// makes one for these names, and keeps it.
    ///
    /// # Errors
    /// The file cannot be read, written or used.
    pub(super) fn read_or_make(path: &Path, names: &[String]) -> anyhow::Result<Self> {
        if !path.try_exists().with_context(|| format!("{} cannot be read", path.display()))? {
            let made = make(names).context("cannot make a certificate")?;
            match files::write_new_private(path, made.as_bytes()) {
                // Another wall was faster, and its certificate is read.
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                written => written.with_context(|| format!("cannot write a new certificate to {}", path.display()))?,
            }
            tracing::info!(
                "{} has a new certificate: browsers warn of it, because nobody else vouches for it",
                path.display()
            );
        }
        let text =
            files::read_text(path, LONGEST_FILE).with_context(|| format!("{} cannot be read", path.display()))?;
        Self::parse(text.as_bytes()).with_context(|| {
            format!(
                "{} is no certificate that can be used: it has a chain of certificates, the wall's own first, and its private \
                 key, all as PEM; without the file, the wall makes one",
                path.display()
            )
        })
    }

    fn parse(pem: &[u8]) -> anyhow::Result<Self> {
        let chain: Vec<_> = CertificateDer::pem_slice_iter(pem).collect::<Result<_, _>>().context("damaged")?;
        let Some(own) = chain.first() else { bail!("it has no certificate") };
        let fingerprint = fingerprint(own);
        let key = PrivateKeyDer::from_pem_slice(pem).context("it has no private key")?;
        let config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_safe_default_protocol_versions()?
            .with_no_client_auth()
            .with_single_cert(chain, key)?;
        let is_own = pem.starts_with(OWN.as_bytes());
        Ok(Self { acceptor: TlsAcceptor::from(Arc::new(config)), fingerprint, is_own })
    }
}

/// A certificate that signs itself, and its key, as PEM.
fn make(names: &[String]) -> anyhow::Result<String> {
    let is_name = |name: &&String| name.parse::<IpAddr>().is_ok_and(|ip| !ip.is_unspecified()) || is_host_name(name);
    let mut names: Vec<_> = names.iter().filter(is_name).cloned().collect();
    names.push("localhost".to_owned());
    names.dedup();
    let mut params = CertificateParams::new(names)?;
    params.distinguished_name = DistinguishedName::new();
    params.distinguished_name.push(DnType::CommonName, "Raywall");
    let now = SystemTime::now();
    // Clocks of phones may be somewhat behind.
    params.not_before = (now - std::time::Duration::from_secs(86_400)).into();
    params.not_after = (now + std::time::Duration::from_secs(DAYS * 86_400)).into();
    let key = KeyPair::generate()?;
    let certificate = params.self_signed(&key)?;
    Ok(format!("{OWN}\n{}{}", certificate.pem(), key.serialize_pem()))
}

fn is_host_name(name: &str) -> bool {
    let is_label =
        |label: &str| !label.is_empty() && label.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-');
    name.parse::<IpAddr>().is_err() && name.split('.').all(is_label)
}

/// Bytes in hexadecimal, with colons.
fn fingerprint(certificate: &CertificateDer<'_>) -> String {
    let mut text = String::new();
    for byte in Sha256::digest(certificate) {
        // Writing to a string cannot fail.
        let _ = write!(text, "{}{byte:02X}", if text.is_empty() { "" } else { ":" });
    }
    text
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_certificate_is_made_once_and_kept_from_others() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("wall.pem");
        let names = ["wall", "wall.local", "192.168.1.7", "0.0.0.0", "::1", "no name!", ""].map(str::to_owned);
        let Certificate { fingerprint: first, is_own, .. } = Certificate::read_or_make(&path, &names).unwrap();
        assert!(is_own);
        assert_eq!((first.len(), first.split(':').count()), (95, 32), "{first}");
        assert_eq!(Certificate::read_or_make(&path, &[]).unwrap().fingerprint, first);
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        }
    }

    #[test]
    fn files_that_are_no_certificate_are_refused_and_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("wall.pem");
        let own = make(&[]).unwrap();
        let (certificate, key) = own.split_at(own.find("-----BEGIN PRIVATE").unwrap());
        let given = format!("{}{key}", certificate.split_once('\n').unwrap().1);
        fs::write(&path, given).unwrap();
        assert!(!Certificate::read_or_make(&path, &[]).unwrap().is_own);
        let other_key = KeyPair::generate().unwrap().serialize_pem();
        let damaged = own.replace("MI", "??");
        let texts =
            ["", "hello", certificate, key, &damaged, &format!("{certificate}{other_key}"), &own[..own.len() / 2]];
        for text in texts {
            fs::write(&path, text).unwrap();
            let Err(error) = Certificate::read_or_make(&path, &[]) else { panic!("accepted: {text}") };
            assert!(format!("{error:#}").contains("the wall makes one"), "{error:#}");
            assert_eq!(fs::read_to_string(&path).unwrap(), *text);
        }
        fs::remove_file(&path).unwrap();
        fs::create_dir(&path).unwrap();
        assert!(Certificate::read_or_make(&path, &[]).is_err());
        assert!(Certificate::read_or_make(&folder.path().join("no/wall.pem"), &[]).is_err());
    }
}
