// Nodes of the C++ monitor. monitored talker|listener SECONDS: publishes on the topic chatter 50 times per second, or
// subscribes to it; prints the number of messages.
#include <scan2sim/fastdds.hpp>

#include <atomic>
#include <iostream>

int main(int, char** argv) {
  const std::string role = argv[1];
  const auto end = std::chrono::steady_clock::now() + std::chrono::duration<double>(std::stod(argv[2]));
  std::atomic<int> count{0};
  {
    scan2sim::fastdds::Monitor node({"cpp_" + role, "/robot", 0.5});
    if (role == "talker") {
      auto publisher = node.create_publisher<std::string>(scan2sim::fastdds::string_type(), "/chatter");
      for (; std::chrono::steady_clock::now() < end; std::this_thread::sleep_for(std::chrono::milliseconds(20)))
        count += publisher.get_subscription_count() > 0 && publisher.publish(std::string(991, 'x'));
    } else {
      node.create_subscription<std::string>(scan2sim::fastdds::string_type(), "/chatter",
                                            [&](const std::string& text) { count += text.size() == 991; });
      std::this_thread::sleep_until(end);
    }
  }
  std::cout << count << std::endl;
}
