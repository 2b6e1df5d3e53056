//! Address of an actor of a node across its restarts.

use std::fmt;
use std::sync::{Arc, PoisonError, RwLock};

use ecod::leadership::timers::ANSWER_STEP;
use ractor::rpc::CallResult;
use ractor::{ActorRef, Message, RpcReplyPort};
use tokio::time::timeout;

/// Address of an actor that survives the actor's restarts. The supervisor sets each new run. A
/// message to an empty slot is dropped, as it would be by an actor that has just ended.
pub struct ActorSlot<M> {
    actor: Arc<RwLock<Option<ActorRef<M>>>>,
}

impl<M: Message> ActorSlot<M> {
    /// Replaces the run of the actor.
    pub fn set(&self, actor: ActorRef<M>) {
        *self.actor.write().unwrap_or_else(PoisonError::into_inner) = Some(actor);
    }

    /// The current run of the actor, if there is one.
    pub fn get(&self) -> Option<ActorRef<M>> {
        self.actor
            .read()
            .unwrap_or_else(PoisonError::into_inner)
            .clone()
    }

    /// Sends to the current run; false if the slot is empty or the actor has just ended.
    pub fn send(&self, message: M) -> bool {
        self.get().is_some_and(|actor| actor.cast(message).is_ok())
    }

    /// The answer of the current run, if it arrives within `steps` times [`ANSWER_STEP`]. A stall
    /// of the whole node takes up one step only.
    pub(crate) async fn ask<T: Send + 'static>(
        &self,
        question: impl FnOnce(RpcReplyPort<T>) -> M,
        steps: usize,
    ) -> Option<T> {
        let actor = self.get()?;
        let answer = actor.call(question, None);
        tokio::pin!(answer);
        for _ in 0..steps {
            if let Ok(answered) = timeout(ANSWER_STEP, &mut answer).await {
                return match answered.ok()? {
                    CallResult::Success(value) => Some(value),
                    CallResult::Timeout | CallResult::SenderError => None,
                };
            }
        }
        None
    }
}

impl<M> Clone for ActorSlot<M> {
    fn clone(&self) -> Self {
        Self {
            actor: Arc::clone(&self.actor),
        }
    }
}

impl<M> Default for ActorSlot<M> {
    fn default() -> Self {
        Self {
            actor: Arc::default(),
        }
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
            sender
                .send(message)
                .map_err(|_| "the receiver was dropped".into())
        }
    }

    /// The slot, and a receiver of the messages sent to it.
    pub(crate) async fn slot<M: Message>() -> (ActorSlot<M>, UnboundedReceiver<M>) {
        let (sender, receiver) = unbounded_channel();
        let slot = ActorSlot::default();
        slot.set(
            Actor::spawn(None, Listener(PhantomData), sender)
                .await
                .unwrap()
                .0,
        );
        (slot, receiver)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use ecod::leadership::timers::ANSWER_STEPS;
    use ractor::{Actor, ActorProcessingErr};

    use super::*;
    use crate::messages::broker::BrokerMessage;
    use crate::transport::broker::BrokerHealth;

    /// Answers a moment after the whole process was stopped.
    struct Held;

    impl Actor for Held {
        type Msg = BrokerMessage;
        type State = ();
        type Arguments = ();

        async fn pre_start(
            &self,
            _: ActorRef<BrokerMessage>,
            (): (),
        ) -> Result<(), ActorProcessingErr> {
            Ok(())
        }

        async fn handle(
            &self,
            _: ActorRef<BrokerMessage>,
            message: BrokerMessage,
            (): &mut (),
        ) -> Result<(), ActorProcessingErr> {
            let BrokerMessage::Health { reply } = message else {
                return Ok(());
            };
            // On a runtime with one thread, all other tasks stop as well.
            std::thread::sleep(Duration::from_millis(1500));
            tokio::time::sleep(Duration::from_millis(20)).await;
            reply.send(BrokerHealth::Stopped)?;
            Ok(())
        }
    }

    #[tokio::test]
    async fn stopped_actor_is_awaited() {
        let slot = ActorSlot::default();
        let (actor, _) = Actor::spawn(None, Held, ()).await.unwrap();
        slot.set(actor);
        let answer = slot
            .ask(|reply| BrokerMessage::Health { reply }, ANSWER_STEPS)
            .await;
        assert_eq!(answer, Some(BrokerHealth::Stopped));
    }
}
