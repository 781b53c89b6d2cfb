// SPDX-License-Identifier: Apache-2.0
// A drive in the place of ours: 1 / (1 + 2ζp/ω + p²/ω²), 0.36 ms late, with the same difference equation and bits.

#include "cell_member.hpp"

#include <deque>

#include <lathe_rc_msgs/msg/actuator_command.hpp>
#include <lathe_rc_msgs/msg/actuator_state.hpp>

using lathe_rc_msgs::msg::ActuatorCommand;
using lathe_rc_msgs::msg::ActuatorState;

namespace {

constexpr double FREQUENCY = 1038.0, DAMPING = 0.804;  // [rad/s], [1]
constexpr size_t DELAY = 23;                           // whole samples of the delay
constexpr double PART = 0.0400000000000027;            // the rest of it [sample]
constexpr double CURRENT = 1.2 / 30.0;                 // moving mass over force constant [A/(m/s²)]

// Position and velocity after a step of 15 625 ns, from those before and from the commands 23, 24 and 25 samples ago:
// exact for a command that is linear between its samples. As lathe_machine.plants.linear.discretise gives them.
constexpr uint32_t STEP_NS = 15625;
constexpr double TRANSITION[2][2] = {
    {0.9998696148817827, 1.542233554902411e-05},
    {-16.61670290328273, 0.9741281329275644},
};
constexpr double WEIGHTS[2][3] = {
    {3.8545948942304446e-05, 9.163419446023194e-05, 2.0497481475476277e-07},
    {7.693103665622411, 8.910475021813182, 0.0131242158471344},
};

// Reads `coarse/command`, publishes `coarse/state`.
class Drive : public CellMember {
public:
    Drive() : CellMember("electrodynamic_actuator", "my_drive") {
        state_ = publishes<ActuatorState>("coarse/state");
        reads<ActuatorCommand>("coarse/command", [this](const ActuatorCommand& it) { return on_command(it); });
    }

private:
    size_t on_command(const ActuatorCommand& command) {
        if (command.block.step_ns != STEP_NS) {
            announce(Member::FAILED, "has the difference equation for sample_rate = 64000, not for this one");
            return 0;
        }
        auto state = beside<ActuatorState>(command);
        for (const double wanted : command.position) {
            step(wanted);
            const double delayed = (1.0 - PART) * line_[2] + PART * line_[1];
            const double spring = FREQUENCY * FREQUENCY * (delayed - position_);
            state.position.push_back(position_);
            state.velocity.push_back(velocity_);
            state.effort.push_back((spring - 2.0 * DAMPING * FREQUENCY * velocity_) * CURRENT);
            state.measured_position.push_back(position_);
        }
        state_->publish(state);
        completed(command, command.position.size());
        return command.position.size();
    }

    void step(double wanted) {
        line_.push_back(wanted);
        line_.pop_front();
        const auto next = [this](const double (&a)[2], const double (&w)[3]) {
            return a[0] * position_ + a[1] * velocity_ + w[0] * line_[2] + w[1] * line_[1] + w[2] * line_[0];
        };
        const double position = next(TRANSITION[0], WEIGHTS[0]);
        velocity_ = next(TRANSITION[1], WEIGHTS[1]);
        position_ = position;
    }

    double position_ = 0.0, velocity_ = 0.0;            // at rest,
    std::deque<double> line_ = std::deque<double>(DELAY + 3);  // nothing on its way
    rclcpp::Publisher<ActuatorState>::SharedPtr state_;
};

}  // namespace

int main(int argc, char** argv) { return run<Drive>(argc, argv); }
