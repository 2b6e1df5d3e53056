//! `ecod-node top`: a cell in a terminal.

use std::fs::File;
use std::io::IsTerminal;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use anyhow::{Context, anyhow};
use clap::Args;
use ratatui::crossterm::event::{self, Event, KeyCode, KeyEventKind, KeyModifiers};
use tokio::signal::unix::{Signal, SignalKind, signal};

use super::Failure;
use super::run::ObserverArguments;
use crate::node::config::NodeConfig;
use crate::node::{self, NodeHandle};
use crate::platform::clock;
use crate::top::{CellView, draw};

/// Flags of `top`.
#[derive(Debug, Args)]
pub(super) struct TopArguments {
    #[command(flatten)]
    observer: ObserverArguments,
}

/// Lines per page of scrolling.
const PAGE: usize = 10;

/// Time between two drawings.
const PERIOD: Duration = Duration::from_millis(250);

/// Joins the cell and draws it until the user quits.
pub(super) fn run(arguments: &TopArguments) -> Result<(), Failure> {
    if !std::io::stdout().is_terminal() {
        return Err(Failure::usage(anyhow!("standard output is not a terminal")));
    }
    let mut config = arguments.observer.load("top")?;
    config.record = None;
    let runtime = tokio::runtime::Runtime::new().context("cannot start threads for the node")?;
    // Created before the node starts, so that the node always leaves the cell before it ends.
    let gone = {
        let _context = runtime.enter();
        [SignalKind::hangup(), SignalKind::terminate()].map(signal)
    };
    let node = runtime
        .block_on(node::start(config.clone()))
        .map_err(|error| anyhow!(error))?;
    let node = Arc::new(Mutex::new(Some(node)));
    let shown_node = Arc::clone(&node);
    // Reading from a closed terminal may block forever: in that case this thread is not waited for.
    let drawing = runtime.spawn_blocking(move || draw_until_quit(&shown_node, &config));
    let shown = runtime.block_on(async {
        tokio::select! {
            shown = drawing => shown.context("the display failed").and_then(|shown| shown.context("cannot draw to the terminal")),
            gone = terminal_gone(gone) => gone.context("cannot leave the terminal"),
        }
    });
    if let Some(node) = lock(&node).take() {
        runtime.block_on(node.stop());
    }
    runtime.shutdown_background();
    Ok(shown?)
}

/// Waits until the terminal is closed, or the program is terminated, and restores the terminal.
async fn terminal_gone([hangup, terminate]: [std::io::Result<Signal>; 2]) -> std::io::Result<()> {
    let mut hangup = hangup?;
    let mut terminate = terminate?;
    let is_closed = tokio::select! {
        _ = hangup.recv() => true,
        _ = terminate.recv() => false,
    };
    if !is_closed {
        ratatui::try_restore()?;
    }
    discard_output()
}

/// Takes over the terminal, and restores it if it still exists.
fn draw_until_quit(node: &Mutex<Option<NodeHandle>>, config: &NodeConfig) -> std::io::Result<()> {
    let is_gone = || !std::io::stdout().is_terminal();
    let shown = ratatui::try_init().and_then(|mut terminal| {
        let shown = show(&mut terminal, node, config);
        if is_gone() { discard_output() } else { shown }
    });
    match shown.and(ratatui::try_restore()) {
        Err(_) if is_gone() => discard_output(),
        shown => shown,
    }
}

/// Discards later output, because writing to a closed terminal fails.
fn discard_output() -> std::io::Result<()> {
    let nowhere = File::options().write(true).open("/dev/null")?;
    rustix::stdio::dup2_stderr(&nowhere)?;
    Ok(rustix::stdio::dup2_stdout(&nowhere)?)
}

fn lock(node: &Mutex<Option<NodeHandle>>) -> MutexGuard<'_, Option<NodeHandle>> {
    node.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Draws the node until the user quits, or the node is stopped.
fn show(
    terminal: &mut ratatui::DefaultTerminal,
    node: &Mutex<Option<NodeHandle>>,
    config: &NodeConfig,
) -> std::io::Result<()> {
    let mut before = None;
    loop {
        let view = lock(node)
            .as_ref()
            .map(|node| CellView::of(node, config, before, clock::now()));
        let Some(mut view) = view else { return Ok(()) };
        terminal.draw(|frame| draw(frame, &mut view))?;
        if event::poll(PERIOD)?
            && let Event::Key(key) = event::read()?
            && key.kind == KeyEventKind::Press
        {
            let interrupted =
                key.modifiers.contains(KeyModifiers::CONTROL) && key.code == KeyCode::Char('c');
            if interrupted || matches!(key.code, KeyCode::Char('q') | KeyCode::Esc) {
                return Ok(());
            }
            view.scroll = match key.code {
                KeyCode::Up => view.scroll.saturating_sub(1),
                KeyCode::Down => view.scroll + 1,
                KeyCode::PageUp => view.scroll.saturating_sub(PAGE),
                KeyCode::PageDown => view.scroll + PAGE,
                _ => view.scroll,
            };
        }
        before = Some(view);
    }
}
