//! The certificate by which remotes know the wall, and that encrypts what they say; the wall makes one if it has none.

use std::{
    fmt::Write,
    io,
    net::IpAddr,
    path::{Path, PathBuf},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, SystemTime},
};

use anyhow::{Context, anyhow, bail};
use channel::files;
use rcgen::{CertificateParams, DistinguishedName, DnType, KeyPair};
use renderer::formats::sources::Stamp;
use sha2::{Digest, Sha256};
use tokio_rustls::{
    TlsAcceptor,
    rustls::{
        ServerConfig,
        crypto::ring,
        pki_types::{CertificateDer, PrivateKeyDer, UnixTime, pem::PemObject},
    },
};
use webpki::{EndEntityCert, KeyUsage, anchor_from_trusted_cert};

/// A chain of certificates and a key are shorter.
const LONGEST_FILE: u64 = 1 << 20;
/// The first line of files that the wall makes.
const OWN: &str = "# Made by a wall: nobody else vouches for it.";
/// Apple's devices trust no certificate for longer than 825 days.
const DAYS: u64 = 820;
/// A wall makes its own certificate anew if it ends within this time.
const DAYS_BEFORE_THE_END: u64 = 30;
const DAY: Duration = Duration::from_secs(86_400);

/// A certificate's file, which is read again when it has changed, as by a program that renews certificates.
#[derive(Debug)]
pub(super) struct CertificateFile {
    path: PathBuf,
    read: Mutex<Read>,
}

/// The certificate that was read last.
#[derive(Debug)]
struct Read {
    /// The file's, while it would tell of any change since.
    stamp: Option<Stamp>,
    certificate: Certificate,
}

/// A certificate, ready to accept connections.
#[derive(Clone)]
pub(super) struct Certificate {
    pub(super) acceptor: TlsAcceptor,
    /// SHA-256 of the wall's own certificate, as browsers show it.
    pub(super) fingerprint: String,
    /// Whether a wall made it, so that browsers warn.
    pub(super) is_own: bool,
    chain: Vec<CertificateDer<'static>>,
}

impl std::fmt::Debug for Certificate {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Certificate").field("fingerprint", &self.fingerprint).finish_non_exhaustive()
    }
}

impl CertificateFile {
    /// Reads a file with a chain of certificates, the wall's own first, and its private key, all as PEM; without such a file,
    /// makes one for these names, and keeps it. One that a wall made is made anew before it ends.
    ///
    /// # Errors
    /// The file cannot be read, written or used.
    pub(super) fn read_or_make(path: &Path, names: &[String]) -> anyhow::Result<Self> {
        let certificate = Certificate::read_or_make(path, names)?;
        Ok(Self { path: path.to_owned(), read: Mutex::new(Read { stamp: None, certificate }) })
    }

    /// The certificate for a new connection. If the file is gone, or has changed and cannot be used, it is the one of before.
    pub(super) fn renewed(&self) -> Certificate {
        let mut read = self.read();
        let now = SystemTime::now();
        // Connections are anybody's, so the log has a line for each change of the file, and none for each of them.
        let Some(stamp) = Stamp::at(&self.path) else { return read.certificate.clone() };
        if read.stamp.as_ref() != Some(&stamp) {
            match Certificate::read(&self.path) {
                Ok(certificate) => {
                    if certificate.fingerprint != read.certificate.fingerprint {
                        tracing::info!(
                            "{} has a new certificate, of SHA-256 {}",
                            self.path.display(),
                            certificate.fingerprint
                        );
                    }
                    read.certificate = certificate;
                }
                Err(error) => tracing::error!("the remote keeps its old certificate: {error:#}"),
            }
            read.stamp = stamp.is_settled(now).then_some(stamp);
        }
        read.certificate.clone()
    }

    /// The certificate that was read last.
    pub(super) fn present(&self) -> Certificate {
        self.read().certificate.clone()
    }

    fn read(&self) -> MutexGuard<'_, Read> {
        self.read.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Certificate {
    fn read_or_make(path: &Path, names: &[String]) -> anyhow::Result<Self> {
        if path.try_exists().with_context(|| format!("{} cannot be read", path.display()))? {
            let read = Self::read(path)?;
            if !read.is_own || read.has_long_to_go() {
                return Ok(read);
            }
            let made = make(names).context("cannot make a certificate")?;
            files::write(path, |out| io::Write::write_all(out, made.as_bytes()))
                .with_context(|| format!("cannot write a new certificate to {}", path.display()))?;
            tracing::info!(
                "the certificate of {} was at its end: it has a new one, of which browsers warn again",
                path.display()
            );
        } else {
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
        Self::read(path)
    }

    fn read(path: &Path) -> anyhow::Result<Self> {
        let text =
            files::read_text(path, LONGEST_FILE).with_context(|| format!("{} cannot be read", path.display()))?;
        let read = Self::parse(text.as_bytes()).with_context(|| {
            format!(
                "{} is no certificate that can be used: it has a chain of certificates, the wall's own first, and its private \
                 key, all as PEM; without the file, the wall makes one",
                path.display()
            )
        })?;
        if let Some(problem) = time_problem(&read.chain, SystemTime::now()) {
            tracing::warn!(
                "{}: {problem}, so browsers refuse it: renew it, and the wall takes it without a restart",
                path.display()
            );
        }
        Ok(read)
    }

    fn has_long_to_go(&self) -> bool {
        time_problem(&self.chain, SystemTime::now() + DAY * DAYS_BEFORE_THE_END as u32).is_none()
    }

    fn parse(pem: &[u8]) -> anyhow::Result<Self> {
        let chain: Vec<_> =
            CertificateDer::pem_slice_iter(pem).collect::<Result<_, _>>().map_err(|_| anyhow!("it is damaged"))?;
        let Some(own) = chain.first() else { bail!("it has no certificate") };
        let fingerprint = fingerprint(own);
        let key = PrivateKeyDer::from_pem_slice(pem).map_err(|_| anyhow!("it has no private key that is whole"))?;
        let config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_safe_default_protocol_versions()?
            .with_no_client_auth()
            .with_single_cert(chain.clone(), key)?;
        let is_own = pem.starts_with(OWN.as_bytes());
        Ok(Self { acceptor: TlsAcceptor::from(Arc::new(config)), fingerprint, is_own, chain })
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
    params.not_before = (now - DAY).into();
    params.not_after = (now + DAY * DAYS as u32).into();
    let key = KeyPair::generate()?;
    let certificate = params.self_signed(&key)?;
    Ok(format!("{OWN}\n{}{}", certificate.pem(), key.serialize_pem()))
}

/// The reason why the first certificate of a chain cannot be used at a time, if that is the time's fault.
fn time_problem(chain: &[CertificateDer<'_>], now: SystemTime) -> Option<&'static str> {
    let own = EndEntityCert::try_from(chain.first()?).ok()?;
    let anchors = [anchor_from_trusted_cert(chain.last()?).ok()?];
    let now = UnixTime::since_unix_epoch(now.duration_since(SystemTime::UNIX_EPOCH).ok()?);
    let verified = own.verify_for_usage(
        webpki::ALL_VERIFICATION_ALGS,
        &anchors,
        chain.get(1..).unwrap_or_default(),
        now,
        KeyUsage::server_auth(),
        None,
        None,
    );
    match verified.err()? {
        webpki::Error::CertExpired { .. } => Some("the certificate has expired"),
        webpki::Error::CertNotValidYet { .. } => Some("the certificate is not valid yet"),
        // Browsers judge the rest.
        _ => None,
    }
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

    /// A certificate that begins and ends so many days from now.
    fn of_days(from: i64, to: i64) -> String {
        let mut params = CertificateParams::new(vec!["wall".to_owned()]).unwrap();
        let at = |days: i64| match u32::try_from(days) {
            Ok(days) => SystemTime::now() + DAY * days,
            Err(_) => SystemTime::now() - DAY * days.unsigned_abs() as u32,
        };
        (params.not_before, params.not_after) = (at(from).into(), at(to).into());
        let key = KeyPair::generate().unwrap();
        format!("{}{}", params.self_signed(&key).unwrap().pem(), key.serialize_pem())
    }

    #[test]
    fn a_certificate_that_ends_is_told_of_and_the_walls_own_is_made_anew() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("wall.pem");
        let problem = |from, to| {
            fs::write(&path, of_days(from, to)).unwrap();
            let before = Certificate::read_or_make(&path, &[]).unwrap();
            assert_eq!(
                Certificate::read_or_make(&path, &[]).unwrap().fingerprint,
                before.fingerprint,
                "it is another's"
            );
            time_problem(&before.chain, SystemTime::now())
        };
        assert_eq!(problem(-1, 5), None);
        assert_eq!(problem(-9, -1), Some("the certificate has expired"));
        assert_eq!(problem(5, 9), Some("the certificate is not valid yet"));
        for (days, is_kept) in [(DAYS_BEFORE_THE_END as i64 + 1, true), (DAYS_BEFORE_THE_END as i64 - 1, false)] {
            fs::write(&path, format!("{OWN}\n{}", of_days(-1, days))).unwrap();
            let before = Certificate::read(&path).unwrap().fingerprint;
            let now = Certificate::read_or_make(&path, &[]).unwrap();
            assert_eq!((now.fingerprint == before, now.is_own), (is_kept, true));
        }
    }

    #[test]
    fn a_renewed_certificate_is_taken_and_a_broken_one_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("wall.pem");
        let file = CertificateFile::read_or_make(&path, &[]).unwrap();
        let first = file.renewed().fingerprint;
        assert_eq!(file.renewed().fingerprint, first);
        fs::write(&path, of_days(-1, 5)).unwrap();
        let second = file.renewed();
        assert!(second.fingerprint != first && !second.is_own);
        for broken in ["", "hello"] {
            fs::write(&path, broken).unwrap();
            assert_eq!(file.renewed().fingerprint, second.fingerprint);
        }
        fs::remove_file(&path).unwrap();
        assert_eq!(file.renewed().fingerprint, second.fingerprint);
        assert_eq!(file.present().fingerprint, second.fingerprint);
    }
}
