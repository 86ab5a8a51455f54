//! Admission: the names under which the wall is reached, pages of other origins, and tokens.

use std::{
    net::IpAddr,
    path::PathBuf,
    sync::{Mutex, PoisonError},
    time::SystemTime,
};

use renderer::formats::sources::Stamp;

use super::tokens::{Role, Token, Tokens};

/// The rules for everybody who asks.
pub(super) struct Access {
    /// The names by which the wall may be asked for, beside addresses: pages of other names cannot reach it, even if they
    /// have their names resolve to its address.
    names: Vec<String>,
    /// `None`: everybody who reaches the address is an operator.
    tokens: Option<TokenFile>,
}

/// A file of tokens, read again when it changes; and the wall's own token, which no file has.
struct TokenFile {
    path: PathBuf,
    own: Token,
    /// The tokens as they were read, while the file's stamp would tell of any change since.
    read: Mutex<Option<(Stamp, Tokens)>>,
}

impl Access {
    pub(super) fn new(names: Vec<String>, tokens: Option<(PathBuf, Token)>) -> Self {
        let tokens = tokens.map(|(path, own)| TokenFile { path, own, read: Mutex::default() });
        Self { names: names.into_iter().map(|name| name.to_ascii_lowercase()).collect(), tokens }
    }

    /// Whether the header `Host` names this wall: by an address, which no name of another page is, or by one of its names.
    pub(super) fn knows_host(&self, host: &str) -> bool {
        let name = without_port(host).to_ascii_lowercase();
        let address = name.strip_prefix('[').and_then(|name| name.strip_suffix(']')).unwrap_or(&name);
        address.parse::<IpAddr>().is_ok() || name == "localhost" || self.names.contains(&name)
    }

    /// The role of a token, or of nobody's; `None` for strangers.
    pub(super) fn role(&self, token: Option<&str>) -> Option<Role> {
        let Some(file) = &self.tokens else { return Some(Role::Operator) };
        let token = token?;
        // Hashes are compared, so that the time tells nothing of the token.
        let is_own = blake3::hash(token.as_bytes()) == blake3::hash(file.own.text().as_bytes());
        if is_own { Some(Role::Visitor) } else { file.role(token) }
    }
}

impl TokenFile {
    fn role(&self, token: &str) -> Option<Role> {
        let mut read = self.read.lock().unwrap_or_else(PoisonError::into_inner);
        let (stamp, now) = (Stamp::at(&self.path)?, SystemTime::now());
        if let Some((of, tokens)) = &*read
            && *of == stamp
        {
            return tokens.role(token);
        }
        let tokens = Tokens::read(&self.path).unwrap_or_else(|error| {
            tracing::error!("nobody gets in by a token: {error:#}");
            Tokens::default()
        });
        let role = tokens.role(token);
        *read = stamp.is_settled(now).then_some((stamp, tokens));
        role
    }
}

/// Whether a page of `origin` is one of this host; programs send no origin.
pub(super) fn is_same_origin(host: &str, origin: Option<&str>) -> bool {
    let Some(origin) = origin else { return true };
    let of_scheme = |scheme| origin.strip_prefix(scheme);
    of_scheme("http://").or_else(|| of_scheme("https://")).is_some_and(|of| of.eq_ignore_ascii_case(host))
}

fn without_port(host: &str) -> &str {
    match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|byte| byte.is_ascii_digit()) => name,
        _ => host,
    }
}

#[cfg(test)]
mod tests {
    use std::{fs, thread, time::Duration};

    use super::*;

    #[test]
    fn only_addresses_and_own_names_reach_the_wall() {
        let access = Access::new(vec!["Wall.example".to_owned()], None);
        for host in ["127.0.0.1:7180", "192.168.1.5", "[::1]:7180", "[fe80::1]", "localhost:7180", "WALL.example:80"] {
            assert!(access.knows_host(host), "{host}");
        }
        for host in ["evil.example", "evil.example:7180", "", ":80", "wall.example.evil.org", "localhost.evil.org"] {
            assert!(!access.knows_host(host), "{host}");
        }
    }

    #[test]
    fn pages_of_other_origins_are_strangers() {
        assert!(is_same_origin("10.0.0.1:7180", None) && is_same_origin("10.0.0.1:7180", Some("http://10.0.0.1:7180")));
        assert!(is_same_origin("wall.example", Some("https://Wall.example")));
        for origin in
            ["null", "http://evil.example", "http://10.0.0.1:7181", "10.0.0.1:7180", "http://10.0.0.1:7180.evil.org"]
        {
            assert!(!is_same_origin("10.0.0.1:7180", Some(origin)), "{origin}");
        }
    }

    #[test]
    fn a_revoked_token_is_forgotten_while_the_wall_runs() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("remote.toml");
        let [own, desk] = [(); 2].map(|()| Token::random().unwrap());
        let mut tokens = Tokens::default();
        tokens.add("desk", Role::Operator, &desk).unwrap();
        tokens.write(&path).unwrap();
        let access = Access::new(Vec::new(), Some((path.clone(), own.clone())));
        assert_eq!([None, Some(""), Some("x")].map(|token| access.role(token)), [None; 3]);
        assert_eq!(access.role(Some(own.text())), Some(Role::Visitor));
        assert_eq!(access.role(Some(desk.text())), Some(Role::Operator));
        tokens.revoke("desk").unwrap();
        tokens.write(&path).unwrap();
        assert_eq!(access.role(Some(desk.text())), None);
        assert_eq!(Access::new(Vec::new(), None).role(None), Some(Role::Operator));
    }

    #[test]
    fn another_token_in_a_file_of_the_same_length_and_time_is_seen() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("remote.toml");
        let [own, old, new] = [(); 3].map(|()| Token::random().unwrap());
        let access = Access::new(Vec::new(), Some((path.clone(), own)));
        let roles = || [&old, &new].map(|token| access.role(Some(token.text())));
        let text_of = |token: &Token| {
            let other = folder.path().join("other.toml");
            let mut tokens = Tokens::default();
            tokens.add("desk", Role::Operator, token).unwrap();
            tokens.write(&other).unwrap();
            fs::read(other).unwrap()
        };
        let texts = [&old, &new].map(text_of);
        assert_eq!(texts[0].len(), texts[1].len());
        // Within one step of the file's clock, and later.
        for pause in [Duration::ZERO, Duration::from_millis(50)] {
            fs::write(&path, &texts[0]).unwrap();
            let modified = fs::metadata(&path).unwrap().modified().unwrap();
            thread::sleep(pause);
            assert_eq!(roles(), [Some(Role::Operator), None]);
            fs::write(&path, &texts[1]).unwrap();
            fs::File::options().write(true).open(&path).unwrap().set_modified(modified).unwrap();
            assert_eq!(roles(), [None, Some(Role::Operator)], "after {pause:?}");
        }
    }
}
