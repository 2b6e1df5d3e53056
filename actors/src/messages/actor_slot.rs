//! Address of an actor of a node across its restarts.

use std::fmt;
use std::sync::{Arc, PoisonError, RwLock};

use ractor::{ActorRef, Message};

/// Address of an actor that survives the actor's restarts. The supervisor sets each new run. A message to an empty
/// slot is dropped, as it would be by an actor that has just ended.
pub struct ActorSlot<M> {
    actor: Arc<RwLock<Option<ActorRef<M>>>>,
}

impl<M: Message> ActorSlot<M> {
    /// Replaces the run of the actor.
    pub fn set(&self, actor: ActorRef<M>) {
        *self.actor.write().unwrap_or_else(PoisonError::into_inner) = Some(actor);
    }

    /// The present run of the actor, if there is one.
    pub fn get(&self) -> Option<ActorRef<M>> {
        self.actor.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Sends to the present run; false when the slot is empty or the actor has just ended.
    pub fn send(&self, message: M) -> bool {
        self.get().is_some_and(|actor| actor.cast(message).is_ok())
    }
}

impl<M> Clone for ActorSlot<M> {
    fn clone(&self) -> Self {
        Self { actor: Arc::clone(&self.actor) }
    }
}

impl<M> Default for ActorSlot<M> {
    fn default() -> Self {
        Self { actor: Arc::default() }
    }
}

impl<M> fmt::Debug for ActorSlot<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ActorSlot").finish_non_exhaustive()
    }
}

#[cfg(test)]
pub(crate) mod listening {
    //! A slot whose messages a test reads.

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

    /// The slot, and what is sent to it.
    pub(crate) async fn slot<M: Message>() -> (ActorSlot<M>, UnboundedReceiver<M>) {
        let (sender, receiver) = unbounded_channel();
        let slot = ActorSlot::default();
        slot.set(Actor::spawn(None, Listener(PhantomData), sender).await.unwrap().0);
        (slot, receiver)
    }
}
