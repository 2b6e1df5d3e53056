//! Rights of a node in the election, as its certificate proves them.

use crate::leadership::config::ElectionConfig;
use crate::leadership::election::{Body, Candidacy, ElectionMessage};
use crate::wire::Role;

/// The most that a node may declare of itself as a candidate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Rights {
    /// The highest role: `edge` above `auto` above `cav`.
    pub role: Role,
    /// The highest priority; a higher value leads first.
    pub priority: u8,
    /// True for an operator's node: it may set the description of the cell.
    pub may_describe: bool,
}

/// Rights of a node that is issued a certificate for a role, with the default priority of nodes.
/// The node is not an operator's.
impl From<Role> for Rights {
    fn from(role: Role) -> Self {
        Self {
            role,
            priority: ElectionConfig::default().priority,
            may_describe: false,
        }
    }
}

impl Rights {
    /// The rights of all nodes in a cell without certificates: every declaration is accepted.
    pub const ALL: Self = Self {
        role: Role::Edge,
        priority: u8::MAX,
        may_describe: true,
    };

    /// The rights of a node that may not lead.
    pub const NONE: Self = Self {
        role: Role::Cav,
        priority: 0,
        may_describe: false,
    };

    /// True if a node may lead at all.
    pub fn may_lead(self) -> bool {
        self.role != Role::Cav
    }

    /// The same rights for an operator's node.
    #[must_use]
    pub fn of_operator(self) -> Self {
        Self {
            may_describe: true,
            ..self
        }
    }

    /// True if a node may declare this role and priority. The priority of a node that may not lead
    /// is ignored.
    pub fn allow(self, role: Role, priority: u8) -> bool {
        role == Role::Cav || rank(role) <= rank(self.role) && priority <= self.priority
    }

    /// The lower of two roles.
    pub fn limit_role(self, role: Role) -> Role {
        if rank(role) <= rank(self.role) {
            role
        } else {
            self.role
        }
    }

    /// The message with role and priority lowered to these rights. `None` if only a node that may
    /// lead may send it.
    pub(crate) fn limit(self, mut message: ElectionMessage) -> Option<ElectionMessage> {
        let claims = matches!(
            message.body,
            Body::Beat { .. }
                | Body::LeaderEvidence { .. }
                | Body::Ready
                | Body::Yield { .. }
                | Body::Offer
                | Body::Resign { .. }
        );
        let Candidacy { role, priority, .. } = message.candidacy;
        message.candidacy.role = self.limit_role(role);
        if message.candidacy.role != Role::Cav {
            message.candidacy.priority = priority.min(self.priority);
        }
        (self.may_lead() || !claims).then_some(message)
    }
}

fn rank(role: Role) -> u8 {
    match role {
        Role::Cav => 0,
        Role::Auto => 1,
        Role::Edge => 2,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn declaration_beyond_certificate_is_refused() {
        let auto = Rights {
            priority: 100,
            ..Rights::from(Role::Auto)
        };
        assert!(
            auto.allow(Role::Auto, 100) && auto.allow(Role::Auto, 7) && auto.allow(Role::Cav, 255)
        );
        assert!(!auto.allow(Role::Auto, 101) && !auto.allow(Role::Edge, 100));
        assert!(Rights::ALL.allow(Role::Edge, 255) && !Rights::NONE.allow(Role::Auto, 0));
        assert_eq!(auto.limit_role(Role::Edge), Role::Auto);
        assert_eq!(Rights::ALL.limit_role(Role::Cav), Role::Cav);
    }
}
