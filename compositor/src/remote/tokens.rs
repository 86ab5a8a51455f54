//! Tokens of remotes: random texts in links, of which a file keeps only hashes.

use std::{
    fmt,
    path::{Path, PathBuf},
};

use anyhow::{Context, bail};
use channel::files;
use serde::{Deserialize, Serialize};
use shared::{printable::printable_line, toml_text::plain_problem};

/// Bytes of a token; nobody guesses 128 bits.
const TOKEN_BYTES: usize = 16;
/// The longest file of tokens.
const LONGEST_FILE: u64 = 1 << 18;
/// The longest name of a token in characters.
const LONGEST_NAME: usize = 40;

/// The rights of a remote.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, strum::Display, strum::EnumString, strum::VariantArray,
)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase", parse_err_ty = String, parse_err_fn = shared::names::unknown_name::<Self>)]
pub enum Role {
    /// Steers, and sees the picture.
    Visitor,
    /// Does everything, and sees the farm.
    Operator,
}

/// A secret text; whoever has it has its role.
#[derive(Clone, PartialEq, Eq)]
pub(crate) struct Token(String);

impl Token {
    /// A new token from the system's random numbers: 32 hexadecimal digits.
    ///
    /// # Errors
    /// The system gives no random numbers.
    pub(crate) fn random() -> anyhow::Result<Self> {
        let mut bytes = [0; TOKEN_BYTES];
        getrandom::fill(&mut bytes).map_err(|error| anyhow::anyhow!("the system gives no random numbers: {error}"))?;
        Ok(Self(bytes.iter().map(|byte| format!("{byte:02x}")).collect()))
    }

    pub(crate) fn text(&self) -> &str {
        &self.0
    }
}

impl fmt::Debug for Token {
    /// Hides the text: logs are read by others.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(..)")
    }
}

/// A kept token: its hash says whether a text is it. A hash of 128 random bits needs neither salt nor stretching.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct KeptToken {
    pub(crate) name: String,
    pub(crate) role: Role,
    blake3: String,
}

/// The tokens of a file.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Tokens {
    #[serde(default, rename = "token")]
    pub(crate) all: Vec<KeptToken>,
}

impl Tokens {
    /// Reads a file of tokens.
    ///
    /// # Errors
    /// One line: it cannot be read, or holds something else.
    pub(crate) fn read(path: &Path) -> anyhow::Result<Self> {
        let text = files::read_text(path, LONGEST_FILE).with_context(|| path.display().to_string())?;
        toml::from_str(&text).map_err(|error: toml::de::Error| {
            let offset = error.span().map_or(0, |span| span.start);
            let line = 1 + text.get(..offset).unwrap_or_default().matches('\n').count();
            anyhow::anyhow!("{}:{line}: {}", path.display(), plain_problem(&text, offset, error.message()))
        })
    }

    /// Adds a token under a name.
    ///
    /// # Errors
    /// The name is taken, empty or too long.
    pub(crate) fn add(&mut self, name: &str, role: Role, token: &Token) -> anyhow::Result<()> {
        if name.is_empty() || name.chars().count() > LONGEST_NAME || printable_line(name) != name {
            bail!("a token's name has from 1 to {LONGEST_NAME} characters that can be printed");
        }
        if self.all.iter().any(|kept| kept.name == name) {
            bail!("there is a token named {name} already: revoke it first, or choose another name");
        }
        self.all.push(KeptToken { name: name.to_owned(), role, blake3: hash(token.text()) });
        Ok(())
    }

    /// Removes the token of a name.
    ///
    /// # Errors
    /// There is none.
    pub(crate) fn revoke(&mut self, name: &str) -> anyhow::Result<()> {
        let names: Vec<_> = self.all.iter().map(|kept| kept.name.clone()).collect();
        let index = names.iter().position(|kept| kept == name);
        let index = index.with_context(|| match names.is_empty() {
            true => format!("there is no token named {name}, and no other"),
            false => format!("there is no token named {name}, only: {}", names.join(", ")),
        })?;
        self.all.remove(index);
        Ok(())
    }

    /// The role of a text that is one of the tokens.
    pub(crate) fn role(&self, text: &str) -> Option<Role> {
        // Hashes are compared, so the time of a comparison tells nothing of a token.
        let hashed = hash(text);
        self.all.iter().find(|kept| kept.blake3 == hashed).map(|kept| kept.role)
    }

    /// Writes the file; a new one is only its owner's.
    ///
    /// # Errors
    /// It cannot be written.
    pub(crate) fn write(&self, path: &Path) -> anyhow::Result<()> {
        let text = format!(
            "# Tokens of a wall's remote: `compositor remote-token` makes and revokes them.\n\n{}",
            toml::to_string(self)?
        );
        let written = if path.exists() {
            files::write(path, |out| out.write_all(text.as_bytes()))
        } else {
            files::write_new_private(path, text.as_bytes())
        };
        written.with_context(|| format!("cannot write {}", path.display()))
    }
}

fn hash(text: &str) -> String {
    blake3::hash(text.as_bytes()).to_hex().to_string()
}

/// Makes, lists and revokes tokens.
#[derive(Clone, Debug, clap::Args)]
pub struct TokenArgs {
    /// The file of tokens, which --remote-tokens gives to the wall; it is made if it is not there
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// The name of a new token, for example of its owner or place; without one, tokens are listed
    #[arg(value_name = "NAME")]
    pub name: Option<String>,
    /// The new token's rights: a visitor steers, an operator does everything
    #[arg(long, value_name = "ROLE", default_value_t = Role::Visitor, requires = "name")]
    pub role: Role,
    /// Revoke the token of this name: the wall forgets it at once
    #[arg(long, value_name = "NAME", conflicts_with = "name")]
    pub revoke: Option<String>,
}

/// Runs `compositor remote-token`.
///
/// # Errors
/// The file cannot be read or written, or there is no such token.
pub fn run(args: &TokenArgs) -> anyhow::Result<()> {
    let path = &args.file;
    let is_new = !path.try_exists().unwrap_or(true) && args.name.is_some();
    let mut tokens = if is_new { Tokens::default() } else { Tokens::read(path)? };
    if let Some(name) = &args.name {
        let token = Token::random()?;
        tokens.add(name, args.role, &token)?;
        tokens.write(path)?;
        return renderer::cli::say(format_args!(
            "{}\nThis {} token is shown only now: add it to the wall's link after #, or send it as Authorization: Bearer",
            token.text(),
            args.role
        ));
    }
    if let Some(name) = &args.revoke {
        tokens.revoke(name)?;
        tokens.write(path)?;
        return renderer::cli::say(format_args!("{name} is revoked"));
    }
    let rows: Vec<_> = tokens.all.iter().map(|kept| format!("{}  {}", kept.role, kept.name)).collect();
    renderer::cli::say(if rows.is_empty() { "no tokens".to_owned() } else { rows.join("\n") })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_opens_until_it_is_revoked_and_is_not_in_its_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("remote.toml");
        let (desk, hall) = (Token::random().unwrap(), Token::random().unwrap());
        let mut tokens = Tokens::default();
        tokens.add("desk", Role::Operator, &desk).unwrap();
        tokens.add("hall", Role::Visitor, &hall).unwrap();
        assert!(tokens.add("hall", Role::Operator, &desk).unwrap_err().to_string().contains("already"));
        tokens.write(&path).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(!text.contains(desk.text()) && !text.contains(hall.text()), "{text}");
        let mut read = Tokens::read(&path).unwrap();
        assert_eq!(read, tokens);
        let roles = [desk.text(), hall.text(), "", "0"].map(|text| read.role(text));
        assert_eq!(roles, [Some(Role::Operator), Some(Role::Visitor), None, None]);
        read.revoke("desk").unwrap();
        assert_eq!(read.role(desk.text()), None);
        assert!(read.revoke("desk").unwrap_err().to_string().ends_with("only: hall"));
        read.write(&path).unwrap();
        assert_eq!(Tokens::read(&path).unwrap(), read);
    }

    #[cfg(unix)]
    #[test]
    fn a_new_file_is_only_its_owners_and_a_broken_one_is_told_in_one_line() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("remote.toml");
        Tokens::default().write(&path).unwrap();
        assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        std::fs::write(&path, "[[token]]\nname = 3\n").unwrap();
        let fault = format!("{:#}", Tokens::read(&path).unwrap_err());
        assert!(fault.contains("remote.toml") && !fault.contains('\n'), "{fault}");
    }
}
