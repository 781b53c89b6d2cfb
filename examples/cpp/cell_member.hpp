// SPDX-License-Identifier: Apache-2.0
// What every member of a cell does, in plain rclcpp; docs/foreign_nodes.md says why.

#pragma once

#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <fstream>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include <lathe_rc_msgs/msg/cell_state.hpp>
#include <lathe_rc_msgs/msg/member.hpp>
#include <lathe_rc_msgs/msg/progress.hpp>
#include <rclcpp/rclcpp.hpp>
#include <std_msgs/msg/empty.hpp>

using lathe_rc_msgs::msg::CellState;
using lathe_rc_msgs::msg::Member;
using lathe_rc_msgs::msg::Progress;

inline rclcpp::QoS latched(size_t depth) { return rclcpp::QoS(depth).reliable().transient_local(); }

// A node that joins, computes what its blocks allow, and leaves with the cell.
class CellMember : public rclcpp::Node {
public:
    CellMember(const std::string& name, const std::string& stage) : Node(name) {
        me_.run_id = so_far_.run_id = declare_parameter("run_id", "");
        window_ = declare_parameter<int64_t>("window", 64);
        me_.name = so_far_.name = get_fully_qualified_name();
        me_.stage = stage;
        me_.parameters = "{}";
        me_.host = host();
        me_.pid = static_cast<uint32_t>(getpid());
        using namespace std::chrono_literals;
        auto alive = rclcpp::QoS(1);
        alive.liveliness(rclcpp::LivelinessPolicy::Automatic).liveliness_lease_duration(80ms);
        alive_ = create_publisher<std_msgs::msg::Empty>("~/alive", alive);
        announcements_ = create_publisher<Member>("members", latched(1));
        progress_ = create_publisher<Progress>("progress", latched(1));
        members_ = create_subscription<Member>("members", latched(256), [this](const Member& it) { on_member(it); });
        cell_state_ = create_subscription<CellState>(
            "cell_state", latched(1), [this](const CellState& it) { on_cell_state(it); });
    }

    void announce(uint8_t state, const std::string& why = "") {
        me_.state = state;
        me_.message = why.substr(0, 1024);
        announcements_->publish(me_);
    }

    int exit_code() const { return exit_code_; }

protected:
    // Lets a callback have the blocks of a topic, of this run and one after the other; it returns their length.
    template <class Block>
    void reads(const std::string& topic, std::function<size_t(const Block&)> callback) {
        auto take = [this, topic, callback, end = std::make_shared<uint64_t>(0)](const Block& message) {
            if (message.block.run_id != me_.run_id || me_.state == Member::FAILED || message.block.first_index < *end) {
                return;  // of another run, or sent once more by a controller that was killed and goes on
            }
            if (message.block.first_index == *end) {
                *end += callback(message);
            } else {
                const auto to = std::to_string(message.block.first_index);
                announce(Member::FAILED, topic + " goes from sample " + std::to_string(*end) + " to " + to);
            }
        };
        const auto subscription = create_subscription<Block>(topic, latched(3 * window_ + 32), std::move(take));
        me_.subscribes.push_back(subscription->get_topic_name());
        subscriptions_.push_back(subscription);
    }

    // A publisher of blocks.
    template <class Block>
    typename rclcpp::Publisher<Block>::SharedPtr publishes(const std::string& topic) {
        const auto publisher = create_publisher<Block>(topic, latched(3 * window_ + 32));
        me_.publishes.push_back(publisher->get_topic_name());
        me_.types.push_back(rosidl_generator_traits::name<Block>());
        me_.sparse.push_back(false);
        return publisher;
    }

    // A block of this node for the samples of another block.
    template <class Made, class Block>
    Made beside(const Block& block) const {
        Made made;
        made.header = block.header;
        made.block = block.block;
        made.block.source = me_.name;
        made.block.companions = 0;
        return made;
    }

    // Tells the time master, at the same blocks as all others.
    template <class Block>
    void completed(const Block& block, size_t samples) {
        so_far_.blocks += 1;
        so_far_.samples += samples;
        if (block.block.last || so_far_.blocks % std::max<uint64_t>(1, window_ / 4) == 0) {
            progress_->publish(so_far_);
        }
    }

private:
    static std::string host() {
        std::string boot;
        std::getline(std::ifstream("/proc/sys/kernel/random/boot_id"), boot);
        struct stat processes {};
        stat("/proc/self/ns/pid", &processes);
        return boot + " " + std::to_string(processes.st_ino);
    }

    void on_member(const Member& member) {
        if (member.run_id == me_.run_id) {
            states_[member.name] = member.state;
            if (!member.members.empty()) {
                named_.assign(member.members.begin(), member.members.end());
            }
        }
        const auto joined = [this](const std::string& name) {
            const auto found = states_.find(name);
            return found != states_.end() && found->second != Member::JOINING;
        };
        if (me_.state == Member::WIRED && !named_.empty() && std::all_of(named_.begin(), named_.end(), joined)) {
            announce(Member::READY);
        }
    }

    void on_cell_state(const CellState& cell) {
        if (cell.run_id != me_.run_id) {
            return;
        }
        if (cell.state == CellState::SAFE) {
            std::string lost;
            for (const auto& name : cell.lost) {
                lost += " " + name;
            }
            announce(Member::FAILED, "cannot go on without" + lost);
        }
        if (cell.state == CellState::ENDED || cell.state == CellState::FAILED) {
            exit_code_ = cell.state == CellState::FAILED || me_.state == Member::FAILED;
            rclcpp::shutdown();
        }
    }

    Member me_;
    Progress so_far_;
    uint64_t window_;
    std::map<std::string, uint8_t> states_;
    std::vector<std::string> named_;
    int exit_code_ = 1;  // also of a node that is ended before its cell
    rclcpp::Publisher<std_msgs::msg::Empty>::SharedPtr alive_;
    rclcpp::Publisher<Member>::SharedPtr announcements_;
    rclcpp::Publisher<Progress>::SharedPtr progress_;
    rclcpp::Subscription<Member>::SharedPtr members_;
    rclcpp::Subscription<CellState>::SharedPtr cell_state_;
    std::vector<rclcpp::SubscriptionBase::SharedPtr> subscriptions_;
};

// Runs a member until its cell has ended; exit code 1 if that failed.
template <class Made>
int run(int argc, char** argv) {
    rclcpp::init(argc, argv);
    const auto member = std::make_shared<Made>();
    member->announce(Member::WIRED);
    rclcpp::spin(member);
    return member->exit_code();
}
