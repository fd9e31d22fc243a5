// Nodes of the C++ monitor. monitored talker|listener: publishes on the topic chatter 50 times per second, or subscribes
// to it, until its input is closed; prints the number of messages.
#include <scan2sim/fastdds.hpp>

#include <atomic>
#include <iostream>

#include <poll.h>

// Waits until the input is closed, for some milliseconds (-1: forever); whether it is closed.
static bool closed(int milliseconds) {
  pollfd input{0, POLLIN, 0};
  return poll(&input, 1, milliseconds) != 0;
}

int main(int, char** argv) {
  const std::string role = argv[1];
  const int depth = 1000;  // nothing is lost if a node stalls for 20 s
  std::atomic<int> count{0};
  {
    scan2sim::fastdds::Monitor node({"cpp_" + role, "/robot", 0.5});
    if (role == "talker") {
      auto publisher = node.create_publisher<std::string>(scan2sim::fastdds::string_type(), "/chatter", depth);
      while (!closed(20))
        count += publisher.get_subscription_count() > 0 && publisher.publish(std::string(991, 'x'));
    } else {
      node.create_subscription<std::string>(scan2sim::fastdds::string_type(), "/chatter",
                                            [&](const std::string& text) { count += text.size() == 991; }, depth);
      closed(-1);
    }
  }
  std::cout << count << std::endl;
}
