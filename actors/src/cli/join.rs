//! `ecod-node init`, `invite` and `join`: creates a cell and adds machines one after the other.

mod files;

use std::io::{BufRead, Read};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, anyhow};
use clap::Args;
use ecod::leadership::Rights;
use ecod::model::names::NodeName;
use nix::ifaddrs::getifaddrs;
use nix::net::if_::InterfaceFlags;
use nix::sys::socket::SockaddrStorage;
use ring::rand::{SecureRandom, SystemRandom};
use serde_json::json;
use tokio::net::TcpListener;
use tokio::time::Instant;

use super::pki::role_named;
use super::{Failure, print, run};
use crate::node::config::NodeConfig;
use crate::platform::bounded_file;
use crate::platform::clock;
use crate::transport::gossip::{DEFAULT_PORT, is_host_and_port};
use crate::transport::invitation::{CityFiles, Host, Token, Visit, Welcome, redeem};
use crate::transport::pki::{Authority, AuthorityError, DEFAULT_DAYS, check_name};
use files::NodeDirectory;

/// Flags of `init`.
#[derive(Debug, Args)]
pub(super) struct InitArguments {
    /// Name of the cell
    cell: NodeName,
    /// Name of this machine's node
    name: NodeName,
    /// Role of the node: `edge` leads whenever it can, `auto` without a better candidate
    #[arg(long, default_value = "auto", value_parser = ["auto", "edge"])]
    role: String,
    /// Directory of the CA of the city that the cell belongs to; by default the cell stands alone
    #[arg(long, value_name = "DIR")]
    city: Option<PathBuf>,
    #[command(flatten)]
    node: NodeArguments,
}

/// Flags of `invite`.
#[derive(Debug, Args)]
pub(super) struct InviteArguments {
    /// Names of the nodes that may join, each on the machine that gets its token
    #[arg(required = true, value_name = "NAME")]
    names: Vec<NodeName>,
    /// Highest role of these nodes: `auto` may take over leadership, `edge` is preferred as leader,
    /// `cav` cannot lead. Invite at least one `auto`, so that the cell continues without its first
    /// machine
    #[arg(long, default_value = "cav", value_parser = ["auto", "cav", "edge"])]
    role: String,
    /// These nodes are an operator's: the cell's description may be set there
    #[arg(long)]
    operator: bool,
    /// Hours for which this command waits for them
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=720))]
    hours: u32,
    /// Address at which they reach this command. Default: a free port at all addresses of this
    /// machine
    #[arg(long, value_name = "IP:PORT")]
    listen: Option<SocketAddr>,
    /// Node through which they find the cell where multicast does not work; may be given several
    /// times. Default: this machine
    #[arg(long = "seed", value_name = "HOST:PORT", value_parser = seed)]
    seeds: Vec<String>,
    #[command(flatten)]
    directory: DirectoryArguments,
}

fn seed(text: &str) -> Result<String, &'static str> {
    if is_host_and_port(text) {
        Ok(text.to_owned())
    } else {
        Err("must be host:port, such as 192.168.1.10:17884")
    }
}

/// Flags of `join`.
#[derive(Debug, Args)]
pub(super) struct JoinArguments {
    /// Token that `ecod-node invite` printed; `-` reads it from standard input, so that the list of
    /// processes does not show it
    token: String,
    #[command(flatten)]
    node: NodeArguments,
}

#[derive(Debug, Args)]
struct NodeArguments {
    #[command(flatten)]
    directory: DirectoryArguments,
    /// Run the node at once, in this terminal
    #[arg(long)]
    run: bool,
}

#[derive(Debug, Args)]
struct DirectoryArguments {
    /// Directory of the node's files [default: /etc/ecod for root, else ./ecod]
    #[arg(long, value_name = "DIR")]
    dir: Option<PathBuf>,
}

impl InitArguments {
    /// True if the command continues as a node.
    pub(super) fn runs_node(&self) -> bool {
        self.node.run
    }
}

impl JoinArguments {
    /// True if the command continues as a node.
    pub(super) fn runs_node(&self) -> bool {
        self.node.run
    }
}

/// Makes a cell's CA and key, and the files of its first node.
pub(super) fn init(arguments: &InitArguments) -> Result<(), Failure> {
    let InitArguments {
        cell,
        name,
        role,
        city,
        ..
    } = arguments;
    // Checked before any file is written: a directory with a CA must not get a second one.
    check_name(name).map_err(Failure::usage)?;
    let directory = arguments.node.directory.vacant()?;
    let role = role_named(role);
    let now = clock::now();
    let mut city = city
        .as_deref()
        .map(Authority::open)
        .transpose()
        .map_err(Failure::usage)?;
    let made = match &mut city {
        Some(city) => city.init_cell(&directory.pki(), cell, now),
        None => Authority::init(&directory.pki(), cell, now),
    };
    let mut authority = made.map_err(|error| anyhow!(error))?;
    let valid = Duration::from_secs(u64::from(DEFAULT_DAYS) * 86_400);
    authority
        .issue(name, Rights::from(role).of_operator(), valid, now)
        .map_err(|error| anyhow!(error))?;
    let (certificate, key) = authority.files_of(name);
    let read = |path: PathBuf| {
        bounded_file::read_text(&path).with_context(|| format!("cannot read {}", path.display()))
    };
    let key_text = read(key.clone())?;
    let welcome = Welcome {
        cell: cell.clone(),
        role,
        certificate: read(certificate)?,
        ca: read(authority.ca())?,
        revocation_list: read(authority.revocation_list())?,
        cell_key: new_cell_key()?,
        seeds: Vec::new(),
        city: city
            .map(|city| {
                anyhow::Ok(CityFiles {
                    ca: read(city.ca())?,
                    revocation_list: read(city.revocation_list())?,
                })
            })
            .transpose()?,
    };
    directory.write(name, &welcome, &key_text)?;
    // The key is in the node's own file.
    std::fs::remove_file(&key).with_context(|| format!("cannot remove {}", key.display()))?;
    directory.hand_over_pki()?;
    print(&format!(
        "made the cell {cell} and its node {name} in {directory}\n\
         keep {}/ca.key secret: it admits nodes to the cell\n\
         admit another node: {}\n\
         while the node runs, set the cell's known locations: ecod-node cell set --config {} cell.toml\n",
        directory.pki().display(),
        directory.command("invite NAME"),
        directory.configuration().display()
    ))?;
    arguments.node.start(&directory)
}

/// Admits nodes until all have joined or the time is over.
pub(super) fn invite(arguments: &InviteArguments) -> Result<(), Failure> {
    let directory = arguments.directory.directory()?;
    let authority = Authority::open(&directory.pki()).map_err(|error| match error {
        AuthorityError::Missing(pki) => anyhow!(
            "{} has no CA: run `ecod-node invite` on the machine where `ecod-node init` made the cell",
            pki.display()
        ),
        error => error.into(),
    })?;
    for name in arguments
        .names
        .iter()
        .filter(|name| authority.has_certificate(name, clock::now()))
    {
        eprintln!(
            "{name} has a certificate already, which stays valid; `ecod-node pki revoke` ends it"
        );
    }
    let city = directory.city(authority.is_of_city().map_err(|error| anyhow!(error))?)?;
    let runtime = tokio::runtime::Runtime::new().context("cannot start threads")?;
    let left = runtime.block_on(async {
        let listener = listen(arguments.listen).await?;
        let bound = listener.local_addr()?;
        let addresses = if bound.ip().is_unspecified() { own_addresses(bound)? } else { vec![bound] };
        let seeds = if arguments.seeds.is_empty() {
            seeds_at(&addresses)
        } else {
            arguments.seeds.clone()
        };
        let mut host = Host::new(authority, directory.cell_key()?, seeds, city)?;
        let role = role_named(&arguments.role);
        for name in &arguments.names {
            let rights = Rights { may_describe: arguments.operator, ..Rights::from(role) };
            let token = host.invite(name, rights, addresses.clone())?;
            print(&format!("on {name}'s machine:\n\n    sudo ecod-node join {token}\n\n"))?;
        }
        let reached: Vec<String> = addresses.iter().map(ToString::to_string).collect();
        eprintln!("waiting at {}; the tokens end with this command", reached.join(", "));
        let until = Instant::now() + Duration::from_secs(u64::from(arguments.hours) * 3600);
        let report_visit = |visit| match visit {
            Visit::Joined(node) => eprintln!("{node} has joined"),
            Visit::UsedAgain(node) => eprintln!(
                "the token of {node} was used twice: the certificate of the first is revoked, copy {} to all nodes. If \
                 that was another machine than {node}'s, change the cell's key, too",
                directory.pki().join("revoked.pem").display()
            ),
            Visit::Failed(from, reason) => eprintln!("{} has not joined: {reason}", from.ip().to_canonical()),
        };
        anyhow::Ok(host.serve(listener, until, report_visit).await)
    })?;
    if left.is_empty() {
        return Ok(());
    }
    let left: Vec<&str> = left.iter().map(NodeName::as_str).collect();
    Err(anyhow!(
        "not joined in {} h: {}; their tokens do not work any more",
        arguments.hours,
        left.join(", ")
    )
    .into())
}

/// Gets and keeps the files of an invited node, or new certificates for a node that has joined before.
pub(super) fn join(arguments: &JoinArguments) -> Result<(), Failure> {
    let token = read_token(&arguments.token).map_err(Failure::usage)?;
    let directory = arguments.node.directory.directory()?;
    let node = &token.node;
    let resident = directory.resident(node).map_err(Failure::usage)?;
    let runtime = tokio::runtime::Runtime::new().context("cannot start threads")?;
    let cell = runtime.block_on(async {
        let joined = redeem(&token).await?;
        match &resident {
            Some(config) => directory.renew(config, &joined.welcome, &joined.key)?,
            None => directory.write(node, &joined.welcome, &joined.key)?,
        }
        let cell = joined.welcome.cell.clone();
        if let Err(error) = joined.keep().await {
            if resident.is_none() {
                directory.vacate()?;
            }
            let again = "run `ecod-node join` again with the same token while `ecod-node invite` still runs there";
            return Err(anyhow!(error).context(format!("the host has no confirmation that {node} has joined: {again}")));
        }
        anyhow::Ok(cell)
    })?;
    if resident.is_some() {
        return Ok(print(&format!(
            "{node} has a new certificate of the cell {cell}; a running node uses it at once\n"
        ))?);
    }
    print(&format!(
        "{node} has joined the cell {cell}; its files are in {directory}\n"
    ))?;
    arguments.node.start(&directory)
}

impl NodeArguments {
    /// Runs the node, makes the system run it, or prints how to start it.
    fn start(&self, directory: &NodeDirectory) -> Result<(), Failure> {
        if self.run {
            let config = NodeConfig::load(Some(&directory.configuration()), &json!({}))
                .map_err(Failure::usage)?;
            return run::run_node(config, false);
        }
        if directory.enable_service()? {
            return Ok(print(
                "the service ecod-node is enabled and runs; details: `systemctl status ecod-node`\n",
            )?);
        }
        let configuration = directory.configuration();
        Ok(print(&format!(
            "start it: ecod-node --config {}\n",
            configuration.display()
        ))?)
    }
}

impl DirectoryArguments {
    fn directory(&self) -> Result<NodeDirectory, Failure> {
        Ok(NodeDirectory::new(self.dir.as_deref())?)
    }

    /// The directory, which must not contain a node yet.
    fn vacant(&self) -> Result<NodeDirectory, Failure> {
        let directory = self.directory()?;
        directory.check_vacant().map_err(Failure::usage)?;
        Ok(directory)
    }
}

/// Most bytes of a token on standard input, with blanks.
const MAX_TOKEN_BYTES: u64 = 64 * 1024;

/// The token in an argument, or on standard input, where it may be broken into lines.
fn read_token(argument: &str) -> anyhow::Result<Token> {
    if argument != "-" {
        return Ok(argument.parse()?);
    }
    let mut input = std::io::stdin().lock().take(MAX_TOKEN_BYTES);
    let mut text = String::new();
    let mut line = String::new();
    // A person who pastes a token does not end the input, but may send an empty line.
    while input.read_line(&mut line)? > 0 && !line.trim().is_empty() {
        text += &line;
        line.clear();
        if let Ok(token) = text.parse() {
            return Ok(token);
        }
    }
    Ok(text.parse()?)
}

/// A key of 64 hexadecimal digits.
fn new_cell_key() -> anyhow::Result<String> {
    let mut key = [0; 32];
    SystemRandom::new()
        .fill(&mut key)
        .map_err(|_| anyhow!("the system gives no random numbers"))?;
    Ok(hex::encode(key) + "\n")
}

/// Listens at an address, or else at a free port of all addresses of this machine.
async fn listen(address: Option<SocketAddr>) -> anyhow::Result<TcpListener> {
    if address.is_none()
        && let Ok(listener) = TcpListener::bind((Ipv6Addr::UNSPECIFIED, 0)).await
    {
        return Ok(listener);
    }
    // Also where the system has no IPv6.
    let address = address.unwrap_or((Ipv4Addr::UNSPECIFIED, 0).into());
    TcpListener::bind(address)
        .await
        .with_context(|| format!("cannot listen on {address}"))
}

/// Addresses at which other machines may reach a port that is bound at all addresses.
fn own_addresses(bound: SocketAddr) -> anyhow::Result<Vec<SocketAddr>> {
    let is_usable = |flags: InterfaceFlags| {
        flags.contains(InterfaceFlags::IFF_UP | InterfaceFlags::IFF_RUNNING)
            && !flags.contains(InterfaceFlags::IFF_LOOPBACK)
    };
    let interfaces = getifaddrs()
        .context("cannot list this machine's addresses; give one by --listen IP:PORT")?;
    let addresses = interfaces.filter(|interface| is_usable(interface.flags));
    let ips = addresses.filter_map(|interface| ip_of(&interface.address?));
    let found = reachable(ips, bound);
    anyhow::ensure!(
        !found.is_empty(),
        "this machine has no address on a network; give one by --listen IP:PORT"
    );
    Ok(found)
}

fn ip_of(address: &SockaddrStorage) -> Option<IpAddr> {
    let v4 = address.as_sockaddr_in().map(|v4| v4.ip().into());
    v4.or_else(|| address.as_sockaddr_in6().map(|v6| v6.ip().into()))
}

/// Most addresses in a token: a guest begins to try one every quarter of a second.
const MAX_ADDRESSES: usize = 16;

/// The addresses of a machine that other machines can use, IPv4 first. Link-local addresses of IPv6
/// are left out: each machine needs its own number of the interface to reach them.
fn reachable(ips: impl Iterator<Item = IpAddr>, bound: SocketAddr) -> Vec<SocketAddr> {
    let is_usable = |ip: &IpAddr| match ip {
        IpAddr::V4(_) => true,
        IpAddr::V6(v6) => bound.is_ipv6() && !v6.is_unicast_link_local(),
    };
    let mut found: Vec<_> = ips
        .filter(is_usable)
        .map(|ip| SocketAddr::new(ip, bound.port()))
        .collect();
    found.sort_by_key(SocketAddr::is_ipv6);
    found.truncate(MAX_ADDRESSES);
    found
}

/// This machine's node as the seed of others. Nodes gossip over IPv4 by default, so addresses of
/// IPv6 are seeds only without any of IPv4.
fn seeds_at(addresses: &[SocketAddr]) -> Vec<String> {
    let has_ipv4 = addresses.iter().any(SocketAddr::is_ipv4);
    addresses
        .iter()
        .filter(|address| address.is_ipv4() == has_ipv4)
        .map(|address| SocketAddr::new(address.ip(), DEFAULT_PORT).to_string())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_have_all_usable_addresses() {
        let ips = "fe80::1 2001:db8::1 10.0.0.1 10.0.1.1 10.0.2.1 10.0.3.1 10.0.4.1 fd00::1";
        let ips = || ips.split(' ').map(|ip| ip.parse().unwrap());
        let found = reachable(ips(), "[::]:7".parse().unwrap());
        let found: Vec<String> = found.iter().map(ToString::to_string).collect();
        assert_eq!(
            found.join(" "),
            "10.0.0.1:7 10.0.1.1:7 10.0.2.1:7 10.0.3.1:7 10.0.4.1:7 [2001:db8::1]:7 [fd00::1]:7"
        );
        let ipv4_only = reachable(ips(), "0.0.0.0:7".parse().unwrap());
        assert_eq!(ipv4_only.len(), 5);
        assert_eq!(seeds_at(&ipv4_only[..1]), ["10.0.0.1:17884"]);
    }

    #[test]
    fn seeds_are_of_one_family() {
        let addresses = ["10.0.0.1:7", "[2001:db8::1]:7"].map(|text| text.parse().unwrap());
        assert_eq!(seeds_at(&addresses), ["10.0.0.1:17884"]);
        assert_eq!(seeds_at(&addresses[1..]), ["[2001:db8::1]:17884"]);
    }
}
