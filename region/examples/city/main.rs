//! A city on one machine: three NATS servers, thousands of simulated cells and some real ones, and what happens to them.
//!
//! `make city` runs it. Each simulated cell has a connection and an account of its own, as a cell's leader has. Each
//! real one is an `ecod-node` with an uplink, and a vehicle that reports to it. Two subscribers on two servers read
//! half of the town each. Vehicles pass through some cells, which report them in every phase.

mod cluster;
mod fleet;
mod places;
mod probe;
mod real;
mod watch;

use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use clap::Parser;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod_actors::platform::clock;
use nix::sys::signal::Signal;
use tempfile::TempDir;

use cluster::{Cluster, SERVERS};
use fleet::Fleet;
use probe::Meter;
use real::RealCells;
use watch::Watch;

/// Flags of the city.
#[derive(Debug, Parser)]
struct Arguments {
    /// Simulated cells
    #[arg(long, default_value_t = 2000)]
    cells: usize,
    /// Maps of each in a second
    #[arg(long, default_value_t = 2.0)]
    hz: f64,
    /// Objects in each map; 25 are 2 kB
    #[arg(long, default_value_t = 25)]
    objects: usize,
    /// Real cells; they need --node
    #[arg(long, default_value_t = 0, requires = "node")]
    real: usize,
    /// The program `ecod-node`
    #[arg(long)]
    node: Option<PathBuf>,
    /// Seconds of each measurement
    #[arg(long, default_value_t = 30)]
    seconds: u64,
    /// Only a steady time, a server that is killed and a restart of all
    #[arg(long)]
    quick: bool,
}

/// Maximum time until a city is whole again.
const PATIENCE: Duration = Duration::from_secs(120);

/// Time before a measurement.
const SETTLE: Duration = Duration::from_secs(5);

/// Time for which a server is stopped by SIGSTOP, and for which cells are cut off.
const PAUSE: Duration = Duration::from_secs(12);

fn main() -> anyhow::Result<()> {
    let arguments = Arguments::parse();
    let directory = TempDir::new()?;
    let places = places::places(arguments.cells, arguments.real);
    let (simulated, real) = places.split_at(arguments.cells);
    let cluster = Cluster::start(directory.path(), &places)?;
    let halves = places::halves(&places);
    let mut city = City {
        of_halves: halves.each_ref().map(|half| half.cells),
        watches: [0, 1]
            .map(|half| Watch::start(cluster.login(half, "region.reader"), &halves[half])),
        fleet: Fleet::start(simulated, &cluster, arguments.hz, arguments.objects)?,
        real: RealCells::start(arguments.node.as_deref(), real, &cluster, directory.path())?,
        cluster,
        cells: places.len(),
        too_old: Vec::new(),
    };
    println!(
        "{} simulated cells at {} Hz, {} real cells, {SERVERS} servers",
        simulated.len(),
        arguments.hz,
        real.len()
    );
    city.until_whole("from nothing", clock::now())?;
    city.steady(arguments.seconds);
    // While all log in at once, a backlog of seconds looks like a clock that is equally late.
    let at_start = city.take_too_old();
    println!(
        "  maps that counted though they were too old, while all logged in for the first time: {}",
        at_start.len()
    );

    println!("\nserver 3 killed");
    let at = clock::now();
    city.cluster.signal(2, Signal::SIGKILL)?;
    city.until_whole("on the two that are left", at)?;
    city.steady(arguments.seconds / 2);
    city.record_too_old("a server was killed");
    city.cluster.restart(2)?;

    if !arguments.quick {
        std::thread::sleep(PAUSE);
        println!("\nserver 2 stopped for {PAUSE:?}, with a subscriber on it");
        let at = clock::now();
        city.cluster.signal(1, Signal::SIGSTOP)?;
        city.until_whole_at(
            &[0],
            "for the half of the cells that is read on another server",
            at,
        )?;
        std::thread::sleep(PAUSE.saturating_sub(clock::now().since(at)));
        let at = clock::now();
        city.cluster.signal(1, Signal::SIGCONT)?;
        city.until_whole("after it goes on", at)?;
        city.record_too_old("a server was stopped and went on");

        if city.real.len() >= 5 {
            println!("\nfive real cells cut off for {PAUSE:?}");
            city.cut_off();
            let at = clock::now();
            city.until_whole("after their return", at)?;
            city.record_too_old("cells were cut off");
        }
    }

    println!("\nall servers killed and started");
    let at = clock::now();
    (0..SERVERS).try_for_each(|server| city.cluster.signal(server, Signal::SIGKILL))?;
    (0..SERVERS).try_for_each(|server| city.cluster.restart(server))?;
    city.until_whole("from the start of the servers", at)?;
    city.steady(arguments.seconds / 2);
    city.overview()?;
    city.record_too_old("all servers were killed");

    let too_old = city.too_old;
    println!(
        "\nmaps that counted though they were too old, since then: {}",
        too_old.len()
    );
    ensure!(
        too_old.is_empty(),
        "{} maps were too old: {:?}",
        too_old.len(),
        too_old.iter().take(10)
    );
    Ok(())
}

struct City {
    watches: [Watch; 2],
    fleet: Fleet,
    real: RealCells,
    cluster: Cluster,
    cells: usize,
    /// Maps that counted though they were too old, by what had happened before.
    too_old: Vec<(String, NodeName, Duration)>,
    /// Cells that each subscriber reads.
    of_halves: [usize; 2],
}

impl City {
    fn until_whole(&self, what: &str, since: Timestamp) -> anyhow::Result<()> {
        self.until_whole_at(&[0, 1], what, since)
    }

    /// Waits until the subscribers have a map of 99 of 100 cells that was sent later than `since`.
    fn until_whole_at(
        &self,
        watches: &[usize],
        what: &str,
        since: Timestamp,
    ) -> anyhow::Result<()> {
        let cells: usize = watches.iter().map(|watch| self.of_halves[*watch]).sum();
        let wanted = cells - cells / 100;
        let begun = Instant::now();
        let mut first = None;
        loop {
            let now = clock::now();
            let fresh: usize = watches
                .iter()
                .map(|watch| self.watches[*watch].sent_after(since))
                .sum();
            if fresh >= cells / 2 {
                first.get_or_insert(now.since(since));
            }
            if fresh >= wanted {
                let half = first.unwrap_or_default().as_secs_f64();
                let all = now.since(since).as_secs_f64();
                println!("  {what}: half of the cells after {half:.1} s, 99 % after {all:.1} s");
                return Ok(());
            }
            let troubles = || self.watches.each_ref().map(Watch::trouble);
            ensure!(
                begun.elapsed() < PATIENCE,
                "only {fresh} of {cells} cells {what}; {:?}",
                troubles()
            );
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    fn take_too_old(&self) -> Vec<(NodeName, Duration)> {
        self.watches.iter().flat_map(Watch::take_too_old).collect()
    }

    /// Notes maps that counted since the last call though they were too old.
    fn record_too_old(&mut self, after: &str) {
        let too_old = self
            .take_too_old()
            .into_iter()
            .map(|(cell, age)| (after.to_owned(), cell, age));
        self.too_old.extend(too_old);
    }

    /// Measures for some seconds, once what came before has settled.
    fn steady(&self, seconds: u64) {
        std::thread::sleep(SETTLE);
        self.watches.iter().for_each(Watch::reset);
        let meters = self
            .cluster
            .pids()
            .into_iter()
            .map(Meter::start)
            .collect::<Vec<_>>();
        let own = Meter::start(std::process::id());
        let nodes = self
            .real
            .pids()
            .into_iter()
            .map(Meter::start)
            .collect::<Vec<_>>();
        let sent_before = self.fleet.sent();
        let begun = Instant::now();
        std::thread::sleep(Duration::from_secs(seconds));
        let span = begun.elapsed().as_secs_f64();
        let sent = (self.fleet.sent() - sent_before) as f64 / span;
        println!("  {seconds} s: simulated cells send {sent:.0} maps/s");
        let mut engine = (0.0, 0.0);
        for (number, meter) in meters.iter().enumerate() {
            let (percent, megabytes) = meter.read();
            engine = (engine.0 + percent, engine.1 + megabytes);
            println!(
                "  server {}: {percent:.0} % of a core, {megabytes:.0} MB",
                number + 1
            );
        }
        for (number, watch) in self.watches.iter().enumerate() {
            println!("  subscriber {}: {}", number + 1, watch.figures(span));
        }
        println!(
            "  engine: {:.0} % of a core, {:.0} MB; this program: {:.0} %",
            engine.0,
            engine.1,
            own.read().0
        );
        if !nodes.is_empty() {
            let percent: f64 =
                nodes.iter().map(|node| node.read().0).sum::<f64>() / nodes.len() as f64;
            println!("  a real node: {percent:.1} % of a core");
        }
    }

    /// Cuts five real cells off, and prints what the uplink cost them.
    fn cut_off(&mut self) {
        let pids: Vec<_> = self.real.pids().into_iter().take(5).collect();
        let mean = || {
            let meters: Vec<_> = pids.iter().map(|pid| Meter::start(*pid)).collect();
            std::thread::sleep(PAUSE);
            let read = meters
                .iter()
                .map(Meter::read)
                .fold((0.0, 0.0), |sum, each| (sum.0 + each.0, sum.1 + each.1));
            (read.0 / meters.len() as f64, read.1 / meters.len() as f64)
        };
        let connected = mean();
        self.real.cut(5);
        let since = clock::now() + Duration::from_secs(1);
        let apart = mean();
        let others: usize = self
            .watches
            .iter()
            .map(|watch| watch.sent_after(since))
            .sum();
        self.real.mend();
        println!("  meanwhile {others} of {} cells are heard", self.cells);
        for (state, (percent, megabytes)) in [
            ("with its uplink", connected),
            ("while it is cut off", apart),
        ] {
            println!("  a real node {state}: {percent:.1} % of a core, {megabytes:.1} MB");
        }
    }

    /// The time in which a new reader gets the status of every cell.
    fn overview(&self) -> anyhow::Result<()> {
        let begun = Instant::now();
        let watch = Watch::start_overview(self.cluster.login(0, "region.reader"));
        while watch.cells() < self.cells {
            ensure!(
                begun.elapsed() < PATIENCE,
                "a new reader gets {} of {} statuses",
                watch.cells(),
                self.cells
            );
            std::thread::sleep(Duration::from_millis(10));
        }
        println!(
            "  a new reader has the status of all {} cells after {:.2} s",
            self.cells,
            begun.elapsed().as_secs_f64()
        );
        Ok(())
    }
}

/// Runs a future on a thread of its own, until the process ends.
fn spawn_thread<F: Future<Output = ()> + Send + 'static>(
    name: &str,
    future: F,
) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let thread = std::thread::Builder::new().name(name.into());
    thread
        .spawn(move || runtime.block_on(future))
        .context("no thread")?;
    Ok(())
}
