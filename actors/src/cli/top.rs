//! `ecod-node top`: a cell in a terminal.

use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, anyhow};
use clap::Args;
use ratatui::crossterm::event::{self, Event, KeyCode, KeyEventKind, KeyModifiers};
use tokio::signal::unix::{SignalKind, signal};

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
    let node = runtime.block_on(node::start(config.clone())).map_err(|error| anyhow!(error))?;
    let is_gone = runtime.block_on(async { terminal_gone() }).context("cannot wait for signals")?;
    let shown = ratatui::run(|terminal| show(terminal, &node, &config, &is_gone));
    runtime.block_on(node.stop());
    Ok(shown.context("cannot draw to the terminal")?)
}

/// Flag that is set when the terminal is closed or the program is told to end: the observer then leaves properly.
fn terminal_gone() -> std::io::Result<Arc<AtomicBool>> {
    let (mut hangup, mut terminate) = (signal(SignalKind::hangup())?, signal(SignalKind::terminate())?);
    let is_gone = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&is_gone);
    tokio::spawn(async move {
        tokio::select! {
            _ = hangup.recv() => {}
            _ = terminate.recv() => {}
        }
        flag.store(true, Ordering::Relaxed);
    });
    Ok(is_gone)
}

fn show(
    terminal: &mut ratatui::DefaultTerminal,
    node: &NodeHandle,
    config: &NodeConfig,
    is_gone: &AtomicBool,
) -> std::io::Result<()> {
    let mut view = CellView::of(node, config, None, clock::now());
    while !is_gone.load(Ordering::Relaxed) {
        terminal.draw(|frame| draw(frame, &mut view))?;
        if event::poll(PERIOD)?
            && let Event::Key(key) = event::read()?
            && key.kind == KeyEventKind::Press
        {
            let interrupted = key.modifiers.contains(KeyModifiers::CONTROL) && key.code == KeyCode::Char('c');
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
        view = CellView::of(node, config, Some(view), clock::now());
    }
    Ok(())
}
