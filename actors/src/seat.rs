//! Where an actor of a node is reached, whichever run of it sits there.

use std::fmt;
use std::sync::{Arc, PoisonError, RwLock};

use ractor::{ActorRef, Message};

/// The place of an actor in its node. The supervisor seats each new run; a message to an empty seat is dropped, as it
/// would be with the actor that just ended.
pub struct Seat<M> {
    holder: Arc<RwLock<Option<ActorRef<M>>>>,
}

impl<M: Message> Seat<M> {
    /// Seats a run of the actor in place of the one before.
    pub fn take(&self, actor: ActorRef<M>) {
        *self.holder.write().unwrap_or_else(PoisonError::into_inner) = Some(actor);
    }

    /// Who sits there.
    pub fn holder(&self) -> Option<ActorRef<M>> {
        self.holder.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Sends to whoever sits there; false when nobody does or the actor has just ended.
    pub fn send(&self, message: M) -> bool {
        self.holder().is_some_and(|actor| actor.cast(message).is_ok())
    }
}

impl<M> Clone for Seat<M> {
    fn clone(&self) -> Self {
        Self { holder: Arc::clone(&self.holder) }
    }
}

impl<M> Default for Seat<M> {
    fn default() -> Self {
        Self { holder: Arc::default() }
    }
}

impl<M> fmt::Debug for Seat<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Seat").finish_non_exhaustive()
    }
}
