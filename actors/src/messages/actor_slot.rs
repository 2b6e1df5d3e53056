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

#[cfg(test)]
pub(crate) mod listening {
    //! A seat whose messages a test reads.

    use std::marker::PhantomData;

    use ractor::{Actor, ActorProcessingErr};
    use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};

    use super::*;

    struct Listener<M>(PhantomData<fn() -> M>);

    impl<M: Message> Actor for Listener<M> {
        type Msg = M;
        type State = UnboundedSender<M>;
        type Arguments = Self::State;

        async fn pre_start(
            &self,
            _myself: ActorRef<M>,
            sender: Self::Arguments,
        ) -> Result<Self::State, ActorProcessingErr> {
            Ok(sender)
        }

        async fn handle(
            &self,
            _myself: ActorRef<M>,
            message: M,
            sender: &mut Self::State,
        ) -> Result<(), ActorProcessingErr> {
            sender.send(message).map_err(|_| "nobody reads".into())
        }
    }

    /// The seat, and what is sent to it.
    pub(crate) async fn seat<M: Message>() -> (Seat<M>, UnboundedReceiver<M>) {
        let (sender, receiver) = unbounded_channel();
        let seat = Seat::default();
        seat.take(Actor::spawn(None, Listener(PhantomData), sender).await.unwrap().0);
        (seat, receiver)
    }
}
